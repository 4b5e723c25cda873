"""A map from drives whose poses are known: every scan deskewed on the reference poses, every point into its voxel.

The poses decide the map, so they are checked before a point is used: a track that jumps, has gaps, or lies elsewhere
than its own GNSS fixes is refused with numbers. Nothing is written until all drives are read.

`build_map` takes every point; what leaves movers out and closes loops (`gnd map build`) is made of the same pieces one
layer higher: `drive_sources`, `MapPoints`, `put_map`.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from gnd.gnd_map.accumulate import N_MIN_CELLS, VoxelAccumulator
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.codec import Lattice, snap
from gnd.gnd_map.errors import MotionError
from gnd.gnd_map.features import is_feature_layer
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame, zones
from gnd.gnd_map.motion import Trajectory, deskew
from gnd.gnd_map.se3 import log_so3, transform
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId, covering_corridor
from gnd.schemas.drive import DriveHeader, GnssTrack, ReferenceTrack, Scan
from gnd.schemas.drive_mcap import drive_counts, load_track, read_drive, read_header
from gnd.tile_store.errors import StoreError
from gnd.tile_store.store import Store
from gnd.tile_store.values import DEFAULT_CODEC, DEFAULT_LAYER, lattice_named

_TILE_M: Final = 40.0

Progress = Callable[[Path, int, int], None]
"""Called with the drive, its scans done, and its scans in all."""


class BuildError(StoreError):
    """Drives that cannot become a map: no poses, impossible poses, nothing measured."""


_MAX_SPEED_MPS: Final = 60.0
"""A faster track jumps."""
_MAX_TURN_RADPS: Final = 3.0
"""A track that turns faster jumps."""
_MAX_GAP_S: Final = 1.0
"""Longer gaps between poses are refused, unless the vehicle stands."""
_STANDING_M: Final = 0.5
"""A vehicle that moved less in a gap stands."""
_MAX_GNSS_OFFSET_M: Final = 30.0
"""Median horizontal distance of poses from GNSS fixes (or five sigma, if larger); beyond, the anchor is wrong."""
POINT_RANGE_M: Final = (2.0, 80.0)
"""Nearer points are the vehicle itself; farther ones are blurred by the heading's error: 0.1 degrees are 14 cm at
80 m."""


@dataclass(frozen=True, slots=True)
class BuildResult:
    """What went into a map and what came out."""

    drives: int
    scans: int
    scans_skipped: int
    """Sweeps that the reference poses do not cover."""
    points: int
    """Points used."""
    tiles: int
    gaussians: int
    versions_published: int
    """Tiles that changed; the others held the same content already."""


@dataclass(frozen=True, slots=True)
class MapSource:
    """One drive, checked, with its poses in the map frame of the build, which is that of the first drive."""

    path: Path
    header: DriveHeader
    poses: Trajectory
    scans: int
    gnss: GnssTrack
    T_map_drive: F64
    """(4, 4) from the drive's own map frame, in which its fixes are, to that of the build."""


def build_map(
    drives: Sequence[Path],
    store: Store,
    *,
    layer: str = DEFAULT_LAYER,
    codec: str = DEFAULT_CODEC,
    n_min_cells: int = N_MIN_CELLS,
    progress: Progress | None = None,
) -> BuildResult:
    """Build the tiles that the drives measured and put them into the store as a new base, all or none.

    A tile that the store holds already is replaced, not mixed with: to add drives to a map, build from all of them.

    Args:
        drives: recordings with reference poses.
        store: where the tiles go.
        layer: such as "ndt"; its name begins so, or it would hold features.
        codec: one of `MAP_CODECS`: the lattice on which the published Gaussians lie, or "float" = as measured.
        n_min_cells: a voxel holds a Gaussian from so many occupied sub-cells on.
        progress: called after each scan.

    Raises:
        BuildError: a feature layer, no drives, no reference poses, impossible poses, no voxel dense enough.
        DriveError: a drive cannot be read.
        StoreError: an unknown codec, or the store cannot take the tiles.
    """
    lattice = map_lattice(layer, codec)
    sources = drive_sources(drives)
    measured = MapPoints(sources)
    used, skipped, points = 0, 0, 0
    for source in sources:
        for points_map_m in _swept(source, progress):
            if points_map_m is None:
                skipped += 1
                continue
            used, points = used + 1, points + len(points_map_m)
            measured.add(points_map_m)
    if used == 0:
        raise BuildError(f"none of {skipped} scans lies within the reference poses: are both in the same clock?")
    tiles = measured.tiles(n_min_cells, lattice)
    return BuildResult(
        drives=len(sources),
        scans=used,
        scans_skipped=skipped,
        points=points,
        tiles=len(tiles),
        gaussians=sum(len(tile.gaussians) for tile in tiles),
        versions_published=put_map(tiles, store, layer, surveyed_ns(sources)),
    )


def map_lattice(layer: str, codec: str) -> Lattice | None:
    """The lattice of a codec, None for "float"; refuses a layer of features and a codec that is not known."""
    lattice = lattice_named(codec)
    if is_feature_layer(layer):
        raise BuildError(f"layer {layer!r} holds features; a map of Gaussians has a name that begins with ndt")
    return lattice


def put_map(tiles: Sequence[Tile], store: Store, layer: str, surveyed_ns: int) -> int:
    """Put tiles into the store as a new base, all or none; how many changed."""
    results = store.put_tiles(tiles, layer=layer, surveyed_ns=surveyed_ns)
    return sum(result.status == "published" for result in results)


def surveyed_ns(sources: Sequence[MapSource]) -> int:
    """When the drives of a map ended: the oldest of them, as each tile may be of that one alone."""
    return min(int(source.poses.t_ns[-1]) for source in sources)


class MapPoints:
    """The points of a build in their voxels, each in its zone of latitude."""

    def __init__(self, sources: Sequence[MapSource]) -> None:
        self.accumulators = tuple(_accumulators(sources))

    def add(self, points_map_m: F64) -> None:
        """Take points (N, 3) in the map frame of the build."""
        for accumulator in self.accumulators:  # each passes over the points of the others
            accumulator.add(points_map_m)

    def tiles(self, n_min_cells: int, lattice: Lattice | None) -> list[Tile]:
        """All tiles, sorted, on the lattice; the store numbers their versions.

        Raises:
            BuildError: no voxel is dense enough.
        """
        return _tiles(self.accumulators, n_min_cells, lattice)


def drive_sources(drives: Sequence[Path]) -> list[MapSource]:
    """The drives with checked poses, all in the map frame of the first.

    Raises:
        BuildError: no drives, no reference poses, impossible poses.
        DriveError: a drive cannot be read.
    """
    if not drives:
        raise BuildError("no drives to build a map from")
    anchor = read_header(drives[0]).anchor
    return [_source(Path(drive), anchor) for drive in drives]


def _source(path: Path, anchor: LocalFrame) -> MapSource:
    header, track = read_header(path), load_track(path)
    header.check_placed()
    check_poses(path, track.reference)
    _check_gnss(path, header.anchor, track.reference, track.gnss)
    T_map_vehicle = anchor.T_self_other(header.anchor) @ track.reference.T_map_vehicle
    poses = Trajectory(track.reference.t_ns, T_map_vehicle)
    T_map_drive = anchor.T_self_other(header.anchor)
    return MapSource(path, header, poses, drive_counts(path).scans, track.gnss, T_map_drive)


def check_poses(path: Path, reference: ReferenceTrack) -> None:
    """Refuse a track that no vehicle can drive.

    Raises:
        BuildError: fewer than two poses, times not increasing, a jump in place or heading, a gap.
    """
    t_ns, T = reference
    if len(t_ns) < 2:
        raise BuildError(f"{path}: {len(t_ns)} reference poses; a map needs known poses (gnd import computes them)")
    step_s = np.diff(t_ns) / 1e9
    _refuse(path, "is not later than the one before", step_s <= 0, step_s, "s")
    step_m = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    turn_rad = np.linalg.norm(log_so3(np.swapaxes(T[:-1, :3, :3], 1, 2) @ T[1:, :3, :3]), axis=1)
    _refuse(path, "jumps", step_m > _MAX_SPEED_MPS * step_s, step_m / step_s, "m/s")
    _refuse(path, "jumps in heading", turn_rad > _MAX_TURN_RADPS * step_s, turn_rad / step_s, "rad/s")
    gap = (step_s > _MAX_GAP_S) & (step_m > _STANDING_M)
    _refuse(path, "comes after a gap", gap, step_s, "s")


def _refuse(path: Path, what: str, bad: "np.ndarray[tuple[int], np.dtype[np.bool_]]", value: F64, unit: str) -> None:
    if bad.any():
        worst = int(np.argmax(np.where(bad, np.abs(value), -1.0)))
        raise BuildError(
            f"{path}: reference pose {worst + 2} of {len(bad) + 1} {what} ({value[worst]:.3g} {unit}), "
            f"so do {bad.sum() - 1} others; the track cannot be a vehicle's"
        )


def _check_gnss(path: Path, anchor: LocalFrame, reference: ReferenceTrack, gnss: GnssTrack) -> None:
    """Refuse poses that lie elsewhere than the drive's own GNSS fixes: a wrong anchor moves a whole map unnoticed."""
    inside = (gnss.t_ns >= reference.t_ns[0]) & (gnss.t_ns <= reference.t_ns[-1])
    if not inside.any():
        return
    fixes_map_m = anchor.enu_from_geodetic(*(column[inside] for column in gnss[1:4]))
    T = Trajectory(*reference).at(gnss.t_ns[inside])
    offset_m = float(np.median(np.linalg.norm((fixes_map_m - T[:, :3, 3])[:, :2], axis=1)))
    allowed_m = max(_MAX_GNSS_OFFSET_M, 5.0 * float(np.median(gnss.sigma_m[inside])))
    if offset_m > allowed_m:
        raise BuildError(
            f"{path}: reference poses lie {offset_m:.1f} m from {inside.sum()} GNSS fixes (median), allowed are "
            f"{allowed_m:.1f} m: is the map frame's anchor right?"
        )


def _accumulators(sources: Sequence[MapSource]) -> list[VoxelAccumulator]:
    """One for each zone of latitude that points may fall into."""
    frame = sources[0].header.anchor
    groups = zones(_reachable_tiles(frame, sources))
    return [VoxelAccumulator(GridFrame.around(frame, tiles)) for tiles in groups.values()]


def _reachable_tiles(frame: LocalFrame, sources: Sequence[MapSource]) -> set[TileId]:
    found: set[TileId] = set()
    for source in sources:
        lat, lon, _ = frame.geodetic_from_enu(source.poses.T_dst_vehicle[:, :3, 3])
        found.update(covering_corridor(lat, lon, POINT_RANGE_M[1] + _TILE_M))
    return found


def _swept(source: MapSource, progress: Progress | None) -> Iterator[F64 | None]:
    """Points (N, 3) in the map frame of each scan; None for a scan that the poses do not cover."""
    done = 0
    for item in read_drive(source.path):
        if isinstance(item, Scan):
            yield _points_map_m(item, source)
            done += 1
            if progress:
                progress(source.path, done, source.scans)


def _points_map_m(scan: Scan, source: MapSource) -> F64 | None:
    range_m = np.linalg.norm(scan.points_m, axis=1)
    kept = (range_m >= POINT_RANGE_M[0]) & (range_m <= POINT_RANGE_M[1])
    points_m, offset_ns = scan.points_m[kept], scan.t_offset_ns[kept]
    try:
        points_vehicle_m = deskew(
            points_m, offset_ns, scan.t_ns, source.poses, source.header.T_vehicle_lidar, scan.t_ns
        )
        return transform(source.poses.at(scan.t_ns), points_vehicle_m)
    except MotionError:
        return None


def _tiles(accumulators: Sequence[VoxelAccumulator], n_min_cells: int, lattice: Lattice | None) -> list[Tile]:
    """All tiles, sorted, on the lattice; the store numbers their versions."""
    found: dict[TileId, Gaussians] = {}
    for accumulator in accumulators:
        found.update(accumulator.finish(n_min_cells))
    if not found:
        voxels = sum(len(accumulator) for accumulator in accumulators)
        raise BuildError(f"none of {voxels} voxels with points has {n_min_cells} occupied sub-cells: too few scans?")
    return [
        Tile(tile, 1, found[tile] if lattice is None else snap(found[tile], lattice, new_map=True))
        for tile in sorted(found)
    ]
