"""A report in two short halves: flags coded against the base tiles and the track; then the Gaussians asked for.

Pure functions: what they make depends on the report, its base tiles and the track only, so a restarted agent packs the
same bytes again, and a study of the traffic can pack without a bus. `gnd.cloud_merger.expanding` undoes it.
"""

import math
from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import I32
from gnd.gnd_map.classes import CHANGED, ChangeClass
from gnd.gnd_map.codec import Flags, decode_mask, encode_flags, encode_measured
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId
from gnd.gnd_map.track import Track, encode_track
from gnd.schemas import limits
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.packed import PackedGaussians, PackedReport, crc_of, digest_of
from gnd.vehicle_agent.errors import PackingError

Bases = Mapping[bytes, Gaussians]
"""The Gaussians of base tiles by content hash; b"" (the vehicle had no map of the tile) need not be among them."""

AT_ONCE_BYTES: Final = 128
"""Gaussians of so many bytes come with the flags. To be asked for them takes a word, a message and its answer: some
490 B plain, 590 B with TLS and seals, beside what they hold (`python -m studies identity-bytes`). So it pays where at
least one such report in four would be asked."""
_STEPS_PER_M = 10_000
_STEPS_PER_RAD = 100_000


def pack(
    report: ChangeReport, bases: Bases, track: Track, at_once_bytes: int = 0, *, is_last: bool = True
) -> PackedReport:
    """The first half of `report`: which voxels it flags, and where the vehicle was.

    Args:
        report: as the detector makes it; what it does not flag as new, modified or deleted, and is not unsure of, is
            not sent.
        bases: at least those that the report's tiles name.
        track: where the vehicle was while the scans counted that the report rests on.
        at_once_bytes: all Gaussians come along where they have no more bytes than that.
        is_last: no report follows soon: word of this one is not to wait for the next one's ack. Where Gaussians are yet
            to be asked for it does not wait, either.

    Raises:
        PackingError: a base is missing, a changed voxel is of another class, something is held back, or the track is
            too long.
        ShapeError: it is unsure of a voxel that its base holds.
        CodecError: the flags cannot be coded.
    """
    if track.way_m > limits.MAX_WAY_OF_REPORT_M:
        raise PackingError(f"{track.way_m:.0f} m of way in one report, the limit is {limits.MAX_WAY_OF_REPORT_M:g} m")
    doubts = [(change.tile.morton - report.district.first_morton, change.doubt) for change in report.tiles]
    if any(doubt is not None and doubt.withheld for _, doubt in doubts):
        raise PackingError(f"report {report.report_id} holds changes back: the track would call them observed")
    unsure = [(change.tile, base_of(change, bases), change.unsure) for change in report.tiles]
    is_unsure = any(len(measured) for _, _, measured in unsure)
    measured = _all_measured(report, bases, at_once_bytes)
    return PackedReport(
        report_id=report.report_id,
        vehicle=report.vehicle,
        sensor_model=report.sensor_model,
        software=report.software,
        first_ns=report.first_ns,
        length_ns=report.last_ns - report.first_ns,
        tiles=tuple(
            (change.tile.morton - report.district.first_morton, change.base_version) for change in report.tiles
        ),
        base_digest=digest_of(change.base_sha for change in report.tiles),
        flags=encode_flags([_flags(change, bases) for change in report.tiles]),
        track=encode_track(track),
        pose_sigma_tenth_mm=_steps_up(max(change.pose_sigma_m for change in report.tiles), _STEPS_PER_M),
        pose_sigma_10urad=_steps_up(max(change.pose_sigma_rad for change in report.tiles), _STEPS_PER_RAD),
        doubts=tuple((index, doubt) for index, doubt in doubts if doubt is not None),
        course=report.course,
        unsure=encode_flags([_new(*one) for one in unsure]) if is_unsure else b"",
        unsure_measured=encode_measured([one for one in unsure if len(one[2])]) if is_unsure else b"",
        measured=measured,
        is_patient=not is_last and (bool(measured) or not askable(report)),
    )


def _all_measured(report: ChangeReport, bases: Bases, most_bytes: int) -> bytes:
    """The Gaussians of all new and modified voxels; empty where they have more bytes than that."""
    n = askable(report)
    if not 0 < n <= most_bytes:  # none has less than a byte
        return b""
    measured = encode_measured(asked_for(report, bases, np.ones(n, np.bool_)))
    return measured if len(measured) <= most_bytes else b""


def pack_measured(report: ChangeReport, bases: Bases, wanted: bytes) -> PackedGaussians:
    """The second half of `report`: the Gaussians that the ack's mask `wanted` asks for.

    The mask runs over `askable(report)`. Gaussians must lie on the lattice "report".

    Raises:
        PackingError: a base is missing.
        CodecError: the mask is damaged or of another length, or a Gaussian is not on the lattice.
    """
    entries = asked_for(report, bases, decode_mask(wanted, askable(report)))
    return PackedGaussians(report.report_id, encode_measured(entries), crc_of(wanted))


def askable(report: ChangeReport) -> int:
    """How many new and modified voxels the report has: of these the cloud may ask for Gaussians."""
    return sum(int(is_measured(change).sum()) for change in report.tiles)


def asked_for(report: ChangeReport, bases: Bases, mask: NDArray[np.bool_]) -> list[tuple[TileId, Gaussians, Gaussians]]:
    """(tile, its base, the Gaussians that are asked for) of each tile of which something is.

    Args:
        report: whose new and modified voxels, in order of tile and voxel id, `mask` marks.
        bases: at least those of these tiles.
        mask: (`askable(report)`,) bool.

    Raises:
        PackingError: a base is missing.
    """
    entries, first = [], 0
    for change in report.tiles:
        rows = np.flatnonzero(is_measured(change))
        chosen = rows[mask[first : first + len(rows)]]
        first += len(rows)
        if len(chosen):
            entries.append((change.tile, base_of(change, bases), change.changed.take(chosen)))
    return entries


def is_measured(change: TileChange) -> NDArray[np.bool_]:
    """(N,) which changed voxels hold a new Gaussian: those that are new or modified."""
    return np.isin(change.change_class, (ChangeClass.NEW, ChangeClass.MODIFIED))


def base_of(change: TileChange, bases: Bases) -> Gaussians:
    """The Gaussians that the change was compared with; none where the vehicle had no map.

    Raises:
        PackingError: the base is missing.
    """
    if not change.base_sha:
        return Gaussians.empty()
    if change.base_sha not in bases:
        raise PackingError(
            f"tile {change.tile}: its base {change.base_sha.hex()[:16]}… is not among {len(bases)} bases"
        )
    return bases[change.base_sha]


def _flags(change: TileChange, bases: Bases) -> Flags:
    if not np.isin(change.change_class, CHANGED).all():
        raise PackingError(f"tile {change.tile}: changed voxels of classes {np.unique(change.change_class).tolist()}")
    voxel_id: I32 = change.changed.voxel_id
    return Flags(change.tile, base_of(change, bases), voxel_id, change.change_class)


def _new(tile: TileId, base: Gaussians, voxels: Gaussians) -> Flags:
    return Flags(tile, base, voxels.voxel_id, np.full(len(voxels), ChangeClass.NEW, np.uint8))


def _steps_up(value: float, steps: int) -> int:
    """Rounded up, so that a vehicle never claims to know its pose better than it does."""
    return math.ceil(value * steps - 1e-6)
