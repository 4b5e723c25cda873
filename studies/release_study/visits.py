"""What single vehicles tell of a tile on trial: simulated drives, localised on a map with one tile changed."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import GnssFix, ReferencePose, Scan
from gnd.schemas.drive_mcap import read_drive, read_header
from gnd.schemas.health import TileHealth
from gnd.vehicle_agent.config import PipelineParameters
from gnd.vehicle_agent.link.trial_telemetry import TrialTelemetry
from gnd.vehicle_agent.local_map import LocalMap, Touched
from gnd.vehicle_agent.localise.estimates import RefinedScan
from gnd.vehicle_agent.localise.parameters import RegistrationParameters
from gnd.vehicle_agent.pipeline import Parts, Pipeline
from gnd.vehicle_agent.tiles_at_hand import TilesAtHand
from studies.frame.errors import ReproduceError


@dataclass(frozen=True, slots=True)
class MapWith:
    """A base map in which some tiles are replaced."""

    base: Mapping[TileId, Tile]
    instead: Mapping[TileId, Tile]

    def tile(self, tile_id: TileId) -> Tile | None:
        """See `TileSource`."""
        return self.instead.get(tile_id, self.base.get(tile_id))


class _Telling:
    """The telemetry of a vehicle that is only localised."""

    def __init__(self, watched: frozenset[TileId]) -> None:
        self._watched = watched
        self.trials: TrialTelemetry | None = None

    def see(self, scan: RefinedScan) -> None:
        assert self.trials is not None
        self.trials.see(scan)

    def made(self, source: MapWith, local_map: LocalMap, touched: Touched) -> TilesAtHand:
        self.trials = TrialTelemetry(local_map, lambda: self._watched, "ndt", RegistrationParameters())
        return TilesAtHand(source, local_map, touched)


def visits(drive: Path, source: MapWith, watched: Iterable[TileId]) -> dict[TileId, TileHealth]:
    """The totals that a vehicle tells of each watched tile when it has left it, or its drive ends; its largest visit.

    Raises:
        ReproduceError: the drive holds no position.
    """
    telling = _Telling(frozenset(watched))
    fix = next((item for item in read_drive(drive) if isinstance(item, GnssFix)), None)
    if fix is None:
        raise ReproduceError(f"{drive}: no position")
    pipeline = Pipeline(
        read_header(drive),
        fix,
        lambda local_map, touched: telling.made(source, local_map, touched),
        PipelineParameters(),
        parts=Parts(placed=(telling.see,)),
    )
    trials, found = telling.trials, dict[TileId, TileHealth]()
    assert trials is not None
    for item in read_drive(drive):
        if isinstance(item, ReferencePose):
            continue
        pipeline.push(item)
        if isinstance(item, Scan):
            trials.note(pipeline.place)
    pipeline.finish()
    for report in trials.due(all_of_it=True):
        for told in report.tiles:
            if told.is_told and told.scans >= found.get(told.tile, told).scans:
                found[told.tile] = told
    return found


def tiles_driven_through(drive: Path) -> list[TileId]:
    """The tiles under a drive's reference poses, in the order of the way."""
    frame: LocalFrame = read_header(drive).anchor
    poses = [item.T_map_vehicle[:3, 3] for item in read_drive(drive) if isinstance(item, ReferencePose)]
    lat, lon, _ = frame.geodetic_from_enu(np.array(poses))
    return list(dict.fromkeys(TileId.from_geodetic(a, b) for a, b in zip(lat.tolist(), lon.tolist(), strict=True)))
