"""From a packed report back to an ordinary one: flags and track against the base tiles, then the Gaussians asked for.

Pure functions, the counterpart of `gnd.vehicle_agent.report.packing`. What comes out is a `ChangeReport` as if the
vehicle had sent it whole, but for four things: observed voxels are those that the track predicts, rays are not counted
(evidence 0), poses are as uncertain as those of the report's worst tile, and a voxel that is new or modified whose
Gaussian did not come has count 0 ("withheld"; its class tells it from one that is deleted).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.errors import BadReport, MissingBase
from gnd.gnd_map.arrays import are_in
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.codec import Flags, decode_flags, decode_measured
from gnd.gnd_map.errors import CodecError, ConfigError, GndError, ShapeError, TrackError
from gnd.gnd_map.gaussian import Gaussians, concat
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import District, TileId
from gnd.gnd_map.track import Track, decode_track
from gnd.gnd_map.visibility import observed_along
from gnd.schemas import limits
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.packed import PackedReport, digest_of

MEASURED: Final = (int(ChangeClass.NEW), int(ChangeClass.MODIFIED))
MAX_PIECES: Final = 128  # of way: each is looked along at four places at least, however short it is
MAX_FLOORS: Final = 400  # of 1 m: looking along a track takes memory for each


def base_versions(packed: PackedReport, district: District) -> tuple[tuple[TileId, int], ...]:
    """The tiles of a packed report on the key of `district`, each with the version that it was compared with."""
    return tuple((TileId(district.first_morton + index), version) for index, version in packed.tiles)


def expand(packed: PackedReport, layer: str, district: District, bases: Sequence[Tile]) -> ChangeReport:
    """The report that `packed` stands for: every Gaussian withheld, or all there where they came along.

    Args:
        packed: as it came on the key of `layer` and `district`.
        layer: of the key.
        district: of the key.
        bases: of `base_versions`, in that order; version 0 and no Gaussians where the vehicle had no map.

    Raises:
        MissingBase: the bases are not those that the vehicle compared with.
        BadReport: flags, track or Gaussians cannot be read against them; more flags than a report may hold, or at
            heights that no vehicle sees.
        SchemaError: a value that no report has.
    """
    shas = [tile.sha if tile.version else b"" for tile in bases]
    if digest_of(shas) != packed.base_digest:
        raise MissingBase(
            f"report {packed.report_id}: the {len(bases)} versions here have digest {digest_of(shas).hex()}, the "
            f"vehicle compared with {packed.base_digest.hex()}"
        )
    try:
        track = decode_track(district, packed.track)  # the short one first: it says how much is to be looked along
        _check_way(packed.report_id, track)
        flags = decode_flags([(tile.tile_id, tile.gaussians) for tile in bases], packed.flags)
        _check_flags(packed.report_id, flags)
        unsure = _unsure(packed, bases, flags)
        observed = observed_along(track, flags)
    except (CodecError, ConfigError, ShapeError, TrackError) as error:
        raise BadReport(f"report {packed.report_id} in {len(packed.flags)} bytes of flags: {error}") from error
    report = ChangeReport(
        report_id=packed.report_id,
        vehicle=packed.vehicle,
        sensor_model=packed.sensor_model,
        software=packed.software,
        district=district,
        first_ns=packed.first_ns,
        last_ns=packed.last_ns,
        tiles=tuple(
            _change(packed, tile, sha, one, observed[tile.tile_id], not_sure)
            for tile, sha, one, not_sure in zip(bases, shas, flags, unsure, strict=True)
        ),
        layer=layer,
        course=packed.course,
    )
    return _with_all_measured(report, bases, packed.measured) if packed.measured else report


def _with_all_measured(report: ChangeReport, bases: Sequence[Tile], measured: bytes) -> ChangeReport:
    every = np.ones(sum(int(is_askable(change).sum()) for change in report.tiles), np.bool_)
    return with_measured(report, {tile.tile_id: tile.gaussians for tile in bases}, every, measured)


def _unsure(packed: PackedReport, bases: Sequence[Tile], flags: Sequence[Flags]) -> list[Gaussians]:
    """Of each tile what the vehicle met and does not decide upon."""
    if not packed.unsure:
        return [Gaussians.empty()] * len(bases)
    told = decode_flags([(tile.tile_id, tile.gaussians) for tile in bases], packed.unsure)
    _check_flags(packed.report_id, told)
    for one, flagged in zip(told, flags, strict=True):
        n = int((one.change_class != ChangeClass.NEW).sum() + are_in(one.voxel_id, flagged.voxel_id).sum())
        if n:
            raise BadReport(
                f"report {packed.report_id}: {n} voxels of tile {one.tile_id} are unsure and flagged or held"
            )
    some = [one for one in told if len(one.voxel_id)]
    met = decode_measured([(one.tile_id, one.base, one.voxel_id) for one in some], packed.unsure_measured)
    by_tile = {one.tile_id: measured for one, measured in zip(some, met, strict=True)}
    return [by_tile.get(tile.tile_id, Gaussians.empty()) for tile in bases]


def _check_way(report_id: str, track: Track) -> None:
    if track.way_m > limits.MAX_WAY_OF_REPORT_M:
        raise BadReport(
            f"report {report_id} rests on {track.way_m:.0f} m of way, the limit is {limits.MAX_WAY_OF_REPORT_M:g} m: "
            f"such a report is read whole only"
        )
    if len(track.pieces) > MAX_PIECES:
        raise BadReport(
            f"report {report_id} rests on {len(track.pieces)} pieces of way, the limit is {MAX_PIECES}: such a report "
            f"is read whole only"
        )


def _check_flags(report_id: str, flags: Sequence[Flags]) -> None:
    """Refuse what would take more memory than any report needs: too many flags, or a world too high."""
    n = sum(len(one.voxel_id) for one in flags)
    if n > limits.MAX_FLAGS_OF_REPORT:
        raise BadReport(f"report {report_id} flags {n} voxels, the limit is {limits.MAX_FLAGS_OF_REPORT}")
    all_floors = np.array([floor for one in flags for floor in _ends(one)], np.int64)
    if len(all_floors) and np.ptp(all_floors) > MAX_FLOORS:
        raise BadReport(
            f"report {report_id} and its bases span floors {all_floors.min()} … {all_floors.max()}, the limit is "
            f"{MAX_FLOORS} floors: such a report is read whole only"
        )


def _ends(flags: Flags) -> list[int]:
    """Lowest and highest floor of the flags and of their base, where there are any: ids ascend floor by floor."""
    ends = [int(ids[at]) for ids in (flags.voxel_id, flags.base.voxel_id) if len(ids) for at in (0, -1)]
    grid = VoxelGrid.of(flags.tile_id)
    return [(voxel_id + grid.nx * grid.ny // 2) // (grid.nx * grid.ny) for voxel_id in ends]


def _change(
    packed: PackedReport, base: Tile, sha: bytes, flags: Flags, observed: NDArray[np.int32], unsure: Gaussians
) -> TileChange:
    n = len(flags.voxel_id)
    return TileChange(
        tile=base.tile_id,
        base_version=base.version,
        base_sha=sha,
        observed=observed[~are_in(observed, unsure.voxel_id)] if len(unsure) else observed,
        changed=_nothing_at(flags.voxel_id),
        change_class=flags.change_class,
        evidence=np.zeros((n, 4), np.int32),
        pose_sigma_m=packed.pose_sigma_m,
        pose_sigma_rad=packed.pose_sigma_rad,
        doubt=packed.doubt_of(base.tile_id.morton % limits.MAX_TILES_OF_DISTRICT),
        unsure=unsure,
    )


def _nothing_at(voxel_id: NDArray[np.int32]) -> Gaussians:
    """No Gaussian at voxels (N,) whose ids ascend."""
    n = len(voxel_id)
    none = np.zeros(n, np.int32)
    return Gaussians(voxel_id, none, none.copy(), np.zeros((n, 3), np.float32), np.zeros((n, 6), np.float32))


def is_askable(change: TileChange) -> NDArray[np.bool_]:
    """(N,) which changed voxels have a Gaussian that can be asked for: those that are new or modified."""
    return np.asarray((change.change_class == MEASURED[0]) | (change.change_class == MEASURED[1]))


def with_measured(
    report: ChangeReport, bases: Mapping[TileId, Gaussians], wanted: NDArray[np.bool_], measured: bytes
) -> ChangeReport:
    """The expanded report with the Gaussians that were asked for in place of withheld ones.

    Args:
        report: of `expand`.
        bases: of its tiles.
        wanted: bool, one for each new or modified voxel of the report, in order of tile and voxel id.
        measured: `PackedGaussians.measured`, of those that are marked.

    Raises:
        BadReport: `measured` cannot be read as the Gaussians of these voxels.
        SchemaError: a covariance that no points in a voxel can have.
    """
    rows = _rows_wanted(report, wanted)
    asked = {change.tile: change.changed.voxel_id[at] for change, at in zip(report.tiles, rows, strict=True) if len(at)}
    try:
        found = decode_measured([(tile, bases[tile], ids) for tile, ids in asked.items()], measured)
    except GndError as error:
        raise BadReport(f"report {report.report_id}: Gaussians of {int(wanted.sum())} voxels: {error}") from error
    by_tile = dict(zip(asked, found, strict=True))
    return replace(report, tiles=tuple(_filled(change, by_tile.get(change.tile)) for change in report.tiles))


def _rows_wanted(report: ChangeReport, wanted: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """Of each tile, the rows of changed voxels whose Gaussian is wanted."""
    found, first = [], 0
    for change in report.tiles:
        rows = np.flatnonzero(is_askable(change))
        found.append(rows[wanted[first : first + len(rows)]])
        first += len(rows)
    return found


def _filled(change: TileChange, measured: Gaussians | None) -> TileChange:
    if measured is None:
        return change
    kept = change.changed.take(~are_in(change.changed.voxel_id, measured.voxel_id))
    return replace(change, changed=concat([kept, measured]))
