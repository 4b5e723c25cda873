"""The run against the truth of its simulated world: the stale map, each drive alone, and the healed map."""

import statistics
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from gnd.cloud_merger.expanding import is_askable
from gnd.deploy.account import TileHistory
from gnd.fleet_sim.evaluate import Evaluation, Tiles, evaluate_maps
from gnd.fleet_sim.truth import LEVELS, Truth
from gnd.gnd_map.gaussian import Gaussians, concat
from gnd.gnd_map.tile import TileDelta, apply, diff
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.values import DEFAULT_LAYER


@dataclass(frozen=True, slots=True)
class RunScores:
    """A run compared with the truth.

    Attributes:
        before: the base map, taken as if nothing had changed.
        single: for each vehicle that drove on the base map alone, the map as its own reports alone would have it.
        helped: for each of the others, the same; but what it saw unchanged is as in the versions that it held, so
            there is in it what others found.
        after: the newest map.
    """

    before: Evaluation
    single: dict[str, Evaluation]
    helped: dict[str, Evaluation]
    after: Evaluation

    def as_dict(self) -> dict[str, Any]:
        """Return macro F1 in percent: observable voxels by stage, and all three levels below `levels`."""
        levels = {level: self._stages(level) for level in LEVELS}
        return {
            **levels["observable"],
            "levels": levels,
            "kept": self.after.kept,
            "single_by_vehicle": _by_vehicle(self.single),
            "helped_by_vehicle": _by_vehicle(self.helped),
        }

    def _stages(self, level: Any) -> dict[str, float | None]:
        alone = [score.f1(level) for score in self.single.values()]
        return {
            "before": round(self.before.f1(level), 2),
            "single": round(statistics.fmean(alone), 2) if alone else None,
            "after": round(self.after.f1(level), 2),
        }


def _by_vehicle(scores: dict[str, Evaluation]) -> dict[str, float]:
    return {name: round(score.f1("observable"), 2) for name, score in sorted(scores.items())}


NO_TRUTH: dict[str, Any] = {"before": None, "single": None, "after": None}


def score_run(truth: Truth, store: SqlStore, histories: Iterable[TileHistory]) -> RunScores:
    """Compare a finished run with the truth.

    Args:
        truth: the truth of the simulated world.
        store: the store of the run: versions and reports.
        histories: every tile before and after.

    Returns:
        The scores of the three stages.
    """
    held = list(histories)
    base = {history.tile.tile: history.before for history in held}
    final = {history.tile.tile: history.after for history in held}
    maps, helped = maps_of_vehicles(store, base, final)
    scores = {vehicle: evaluate_maps(truth, base, own) for vehicle, own in maps.items()}
    return RunScores(
        before=evaluate_maps(truth, base, base),
        single={vehicle: score for vehicle, score in scores.items() if vehicle not in helped},
        helped={vehicle: score for vehicle, score in scores.items() if vehicle in helped},
        after=evaluate_maps(truth, base, final),
    )


def maps_of_vehicles(store: SqlStore, base: Tiles, final: Tiles) -> tuple[dict[str, dict[TileId, Gaussians]], set[str]]:
    """Return for each vehicle the base map changed by its own reports, and which vehicles held more than the base map.

    A voxel that it observed is as it said: the new Gaussian, nothing, or as in the version that it held. Where the
    cloud had Gaussians enough and did not ask for the vehicle's own, that of the final map stands in for it.
    """
    maps: dict[str, dict[TileId, Gaussians]] = defaultdict(lambda: dict(base))
    helped: set[str] = set()
    for row in store.reports():
        for change in ChangeReport.decode(row.body).tiles:
            held = _held(store, change, base)
            if change.base_sha and held != base.get(change.tile, Gaussians.empty()):
                helped.add(row.vehicle)
            alone = maps[row.vehicle]
            alone[change.tile] = with_statement(
                alone.get(change.tile, Gaussians.empty()), held, change, final.get(change.tile, Gaussians.empty())
            )
    return dict(maps), helped


def with_statement(tile: Gaussians, held: Gaussians, change: TileChange, final: Gaussians) -> Gaussians:
    """Return a tile after what one report says about it.

    Args:
        tile: the tile before.
        held: the version that the vehicle compared with.
        change: its statement.
        final: where Gaussians that were not asked for are taken from.
    """
    as_held = diff(tile.select(change.observed), held.select(change.observed))
    said = change.changed
    withheld = is_askable(change) & ~said.exists
    there = concat([said.take(said.exists), final.select(said.voxel_id[withheld])])
    gone = said.voxel_id[~said.exists & ~withheld]
    after = apply(tile, as_held)
    return apply(after, TileDelta(np.intersect1d(gone, after.voxel_id), there))


def _held(store: SqlStore, change: TileChange, base: Tiles) -> Gaussians:
    if not change.base_sha:
        return Gaussians.empty()
    stored = store.by_sha(DEFAULT_LAYER, change.tile, change.base_sha)
    return base.get(change.tile, Gaussians.empty()) if stored is None else stored.decode_gaussians().gaussians
