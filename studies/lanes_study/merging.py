"""What the cloud makes of the drives of a street, and how that compares with the truth, by size of the fleet."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from gnd.cloud_merger.features import FeatureMergeParameters, merge_layer
from gnd.deploy.lane_edits import MapEdits, lane_edits, map_pieces
from gnd.gnd_map.features import Feature
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.features import FeatureReport
from gnd.vehicle_agent.features.lanes.lane_mapper import MARKINGS
from studies.lanes_study.driving import SOURCE, LaneDrive, LaneTask, hd_map
from studies.lanes_study.scores import score_edits, score_layer, told

Layer = Mapping[TileId, Sequence[Feature]]


def merged(reports: Sequence[FeatureReport], epochs: Layer | None = None) -> dict[TileId, tuple[Feature, ...]]:
    """The layer that the cloud publishes."""
    parameters = FeatureMergeParameters().of_layer(MARKINGS)
    return {tile: one.features for tile, one in merge_layer(epochs or {}, reports, parameters).items()}


def fresh_layer(drives: Sequence[LaneDrive]) -> dict[TileId, tuple[Feature, ...]]:
    """The layer of vehicles without any map."""
    return merged([report for one in drives for report in one.fresh])


def map_edits(task: LaneTask, drives: Sequence[LaneDrive]) -> MapEdits:
    """The edits of the HD map that the drives ask for."""
    file = hd_map(task.paint)
    epochs = {tile: one.features for tile, one in map_pieces(file.features).items()}
    layer = merged([report for one in drives for report in one.with_map], epochs)
    return lane_edits(file, layer, SOURCE)


def outcome_of(
    tasks: Sequence[LaneTask], drives: Sequence[Sequence[LaneDrive]], fleets: Sequence[int]
) -> dict[str, Any]:
    """Figures by size of the fleet: `layer.<n>`, `edits.<n>`, and what the drives withheld."""
    layer, edits = {}, {}
    for n in fleets:
        scores = [
            score_layer(task.paint, "after", fresh_layer(some[:n])) for task, some in zip(tasks, drives, strict=True)
        ]
        layer[str(n)] = told(scores)
        rows = [_edits_row(task, some[:n]) for task, some in zip(tasks, drives, strict=True)]
        edits[str(n)] = _together(rows)
    counts = sum((_withheld(one) for some in drives for one in some), Counter[str]())
    return {"layer": layer, "edits": edits, "withheld": dict(counts)}


def _withheld(drive: LaneDrive) -> Counter[str]:
    return Counter({name: drive.counts.get(name, 0) for name in ("doubtful", "blind")})


def _edits_row(task: LaneTask, drives: Sequence[LaneDrive]) -> dict[str, Any]:
    return score_edits(task.paint, hd_map(task.paint), map_edits(task, drives))


def _together(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    sums = {key: sum(row[key] for row in rows) for key in ("changes", "found", "edits", "right", "partly")}
    lists = {key: [one for row in rows for one in row[key]] for key in ("wrong", "missed")}
    km = sum(row["kept_km"] for row in rows)
    return sums | lists | {"kept_km": round(km, 3), "false_per_km": round(len(lists["wrong"]) / km, 2) if km else None}
