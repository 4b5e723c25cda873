"""A vehicle that is fed measurement by measurement: it localises on a map, finds what changed, and reports it."""

import importlib
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

import numpy as np
import numpy.typing as npt

from gnd.client import Client
from gnd.extras import explained, need_vehicle
from gnd.gnd_map.content import AnyTile
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.features import FeatureTile
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.map_reader import Map
from gnd.schemas.drive import Deskew, DriveHeader, DriveItem, GnssFix, MotionSample, ReferencePose, Scan
from gnd.schemas.tiles import as_kind
from gnd.tile_store.store import Store
from gnd.tile_store.values import DEFAULT_LAYER

if TYPE_CHECKING:
    from gnd.vehicle_agent.config import PipelineParameters
    from gnd.vehicle_agent.pipeline import Output, Pipeline
    from gnd.vehicle_agent.place import Place
    from gnd.vehicle_agent.tiles_at_hand import TilesAtHand

WAITED_NS: Final = 10_000_000_000
"""Before the first position, measurements of the last so many nanoseconds are kept, ..."""
MOST_WAITING: Final = 20_000
"""... at most so many."""
Fetch = Callable[[str, Sequence[TileId]], Iterator[AnyTile]]
"""The newest tiles of a layer, those of the given ids that there are."""
_ANYWHERE: Final = LocalFrame(0.0, 0.0)


class NoPosition(GndError):
    """A vehicle was asked for what only a first position could tell."""


class Vehicle:
    """One drive of one vehicle; use it in a `with` block, `push` measurements in the order of their times.

    Until the first position (`GnssFix`) comes, the measurements of the last ten seconds wait for it. Poses are in
    `frame`: east, north, up in metres at the tile of the first position. It starts no thread and looks at no clock: all
    work is done in `push`, in the caller's thread.

    Args:
        map: the map, or its file; or a client of the bus, from which tiles are fetched as they are needed, those of a
            district with one question.
        mount: (4, 4) T_vehicle_lidar: p_vehicle = T_vehicle_lidar @ p_lidar, x forward, z up, m.
        name: pseudonym of the vehicle, in its reports. [1-64 of A-Z a-z 0-9 . _ -]
        sensor_model: such as "VLP-16".
        drive_id: name of the drive, in its reports; "": the vehicle's name and the time of its first position.
        deskew: what is known of the times of points within a sweep; see `gnd.schemas.drive.Deskew`.
        sweep_ns: how long a sweep lasts, ns; 0 = not told.
        reports: False: it only localises.
        layer: a layer of Gaussians.
        parameters: of the algorithms; with feature layers the map's features are fetched as well.

    Raises:
        BadValue: a mount that is no rigid transform, or a name that is none.
        StoreUnavailable: no such map.
        MissingExtra: `gnd-fleet[vehicle]` is not installed.
    """

    def __init__(
        self,
        map: Map | Client | str | Path,  # noqa: A002  (what users call it)
        mount: npt.ArrayLike,
        *,
        name: str = "vehicle",
        sensor_model: str = "unknown",
        drive_id: str = "",
        deskew: Deskew = "unsaid",
        sweep_ns: int = 0,
        reports: bool = True,
        layer: str = DEFAULT_LAYER,
        parameters: "PipelineParameters | None" = None,
    ) -> None:
        need_vehicle()
        with explained():
            importlib.import_module("gnd.vehicle_agent.pipeline")  # now, not at the first position
        T_vehicle_lidar = np.ascontiguousarray(mount, np.float64)
        self._header = DriveHeader(
            drive_id or name, name, sensor_model, _ANYWHERE, T_vehicle_lidar, deskew=deskew, sweep_ns=sweep_ns
        )
        self._drive_id, self._reports, self._layer, self._parameters = drive_id, reports, layer, parameters
        self._waiting: deque[DriveItem] = deque(maxlen=MOST_WAITING)
        self._pipeline: Pipeline[TilesAtHand] | None = None
        self._open = ExitStack()
        self._fetch = self._fetch_of(map)

    @classmethod
    def of_drive(
        cls,
        map: Map | Client | str | Path,  # noqa: A002
        header: DriveHeader,
        *,
        reports: bool = True,
        layer: str = DEFAULT_LAYER,
    ) -> Self:
        """A vehicle like the one of a recorded drive, with all that the recording tells of sensor and mount."""
        vehicle = cls(map, header.T_vehicle_lidar, name=header.vehicle, reports=reports, layer=layer)
        vehicle._header, vehicle._drive_id = header, header.drive_id
        return vehicle

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the map, if this has opened it. May be called again; nothing can be pushed afterwards."""
        self._open.close()

    @property
    def pipeline(self) -> "Pipeline[TilesAtHand]":
        """What is behind it, for what this class does not do.

        Raises:
            NoPosition: no position has come yet.
        """
        if self._pipeline is None:
            raise NoPosition(f"{self._header.vehicle}: no GNSS fix has come, {len(self._waiting)} measurements wait")
        return self._pipeline

    @property
    def frame(self) -> LocalFrame:
        """The frame of all poses: ENU at the centre of the first position's tile, on the ellipsoid.

        Raises:
            NoPosition: no position has come yet.
        """
        return self.pipeline.place.frame

    def push(self, item: DriveItem) -> "Output":
        """Take the next measurement.

        Args:
            item: a `Scan`, `MotionSample`, `GnssFix` or `Detections` of `gnd.schemas.drive`; a `ReferencePose`, which
                no vehicle has, is left out. One that cannot be used is counted (`pipeline.guard.bad`) and left out.

        Returns:
            What has come of it: `poses` that became final, `reports` that were decided, the newest pose `online`, and
            its `health` and `cause`.
        """
        if self._pipeline is not None:
            return self._pipeline.push(item)
        from gnd.vehicle_agent.pipeline import Output

        if not isinstance(item, ReferencePose):
            self._waiting.append(item)
        while self._waiting and item.t_ns - self._waiting[0].t_ns > WAITED_NS:
            self._waiting.popleft()
        if not isinstance(item, GnssFix):
            return Output((), (), None, "lost", "no_position")
        pipeline = self._pipeline = self._begin(item)
        outputs = [pipeline.push(one) for one in self._waiting]
        self._waiting.clear()
        poses = tuple(pose for output in outputs for pose in output.poses)
        reports = tuple(report for output in outputs for report in output.reports)
        return Output(poses, reports, outputs[-1].online, outputs[-1].health, outputs[-1].cause)

    def push_scan(self, t_ns: int, points_m: npt.ArrayLike, t_offset_ns: npt.ArrayLike | None = None) -> "Output":
        """Take one sweep of the LiDAR, in firing order, as measured: not deskewed.

        Args:
            t_ns: start of the sweep, ns UTC.
            points_m: (N, 3) in the LiDAR's frame, m.
            t_offset_ns: (N,) time of each point after `t_ns`, ns; None: not known.
        """
        points = np.ascontiguousarray(points_m, np.float32)
        offsets = np.zeros(len(points), np.uint32) if t_offset_ns is None else np.asarray(t_offset_ns, np.uint32)
        return self.push(Scan(int(t_ns), points, np.ascontiguousarray(offsets)))

    def push_motion(self, t_ns: int, speed_mps: float, yaw_rate_radps: float) -> "Output":
        """Take wheel speed (forward positive, m/s) and yaw rate (counter-clockwise positive, rad/s)."""
        return self.push(MotionSample(int(t_ns), float(speed_mps), float(yaw_rate_radps)))

    def push_gnss(self, t_ns: int, lat_deg: float, lon_deg: float, height_m: float, sigma_m: float) -> "Output":
        """Take a position: WGS-84, degrees, m above the ellipsoid; `sigma_m` one sigma of each axis."""
        return self.push(
            GnssFix(int(t_ns), float(np.radians(lat_deg)), float(np.radians(lon_deg)), float(height_m), float(sigma_m))
        )

    def finish(self) -> "Output":
        """The drive has ended: what waits is judged, decided and reported."""
        return self.pipeline.finish()

    def _fetch_of(self, map_given: Map | Client | str | Path) -> Fetch:
        if isinstance(map_given, Client):
            return lambda layer, tiles: map_given.fetch(tiles, layer=layer)
        opened = map_given if isinstance(map_given, Map) else self._open.enter_context(Map(map_given))
        return lambda layer, tiles: _stored(opened.store, layer, tiles)

    def _begin(self, fix: GnssFix) -> "Pipeline[TilesAtHand]":
        from gnd.vehicle_agent.pipeline import Pipeline
        from gnd.vehicle_agent.report.reporter import Identity
        from gnd.vehicle_agent.tiles_at_hand import TilesAtHand

        header, source = self._header, TilesOfMap(self._fetch, self._layer)
        features = () if self._parameters is None else self._parameters.features.layers
        drive_id = self._drive_id or f"{header.vehicle[:40]}-{fix.t_ns}"
        identity = Identity(header.vehicle, drive_id, header.sensor_model, self._layer) if self._reports else None
        return Pipeline(
            header,
            fix,
            lambda local_map, touched: TilesAtHand(source, local_map, touched),
            self._parameters,
            identity=identity,
            outbox=_Passed(),
            feature_tiles=FeatureTilesOfMap(self._fetch, [layer.name for layer in features]),
        )


def _stored(store: Store, layer: str, tiles: Sequence[TileId]) -> Iterator[AnyTile]:
    found = (store.get(layer, tile_id) for tile_id in tiles)
    return (stored.decode() for stored in found if stored is not None)


@dataclass(frozen=True, slots=True)
class TilesOfMap:
    """A layer of Gaussians as the `DistantTileSource` of a drive."""

    fetch: Fetch
    layer: str

    def tile(self, tile_id: TileId) -> Tile | None:
        """The tile of that id, or None where the map has none."""
        return self.tiles_of([tile_id]).get(tile_id)

    def tiles_of(self, wanted: Sequence[TileId]) -> dict[TileId, Tile]:
        """Those of the wanted tiles that the map has."""
        return {tile.tile_id: as_kind(tile, Tile) for tile in self.fetch(self.layer, wanted)}


class FeatureTilesOfMap:
    """The features of the map along a drive: those around and ahead are fetched after some way, each tile once."""

    def __init__(self, fetch: Fetch, layers: Sequence[str]) -> None:
        from gnd.vehicle_agent.link.feature_tiles_on_the_bus import FeatureTilesAhead

        self._fetch, self._layers, self._ahead = fetch, tuple(layers), FeatureTilesAhead()
        self._known: set[TileId] = set()

    def follow(self, place: "Place") -> Iterator[tuple[str, FeatureTile]]:
        """The tiles that were not given yet, with the names of their layers. Those that a lost link did not bring are
        asked for again after some more way.
        """
        new = sorted(set(self._ahead.of(place)) - self._known)
        for layer in self._layers if new else ():
            for tile in self._fetch(layer, new):
                yield layer, as_kind(tile, FeatureTile)
        self._known.update(new)


class _Passed:
    """A sink of reports that are handed to the caller: of each only the id is kept."""

    def __init__(self) -> None:
        self._ids: set[str] = set()

    def put(self, report_id: str, _key: str, _body: bytes, _packed: bytes = b"", _bases: object = ()) -> bool:
        known = report_id in self._ids
        self._ids.add(report_id)
        return not known

    def body_of(self, _report_id: str) -> bytes | None:
        return None

    def hides(self, _tile: TileId) -> bool:
        return False
