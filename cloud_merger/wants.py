"""Which Gaussians of a packed report the cloud asks for: only those that could still change the map.

Pure functions of what the report flags and of what the store already holds about its tiles, so a study of the traffic
can ask without a bus. Asking too little costs quality, asking too much costs bytes: the merge decides by votes, and a
flag without its Gaussian is a vote already.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.errors import MergerError
from gnd.cloud_merger.expanding import is_askable
from gnd.cloud_merger.memory import TileMemory
from gnd.cloud_merger.parameters import MERGE_XI_RESHAPED, MergeParameters
from gnd.cloud_merger.statements import (
    EPOCH,
    Kind,
    Report,
    find,
    same_state,
    states_at,
)
from gnd.cloud_merger.votes import TileVotes, quotable
from gnd.gnd_map.arrays import I32
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.day import day_of
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.settings import check_settings, setting
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport, TileChange

WANT_SHARE: Final = 0.8
"""All that could agree with a Gaussian, itself included, must hold more than this share of ξ of the votes; below 1
because votes that come later may lift it over ξ."""


@dataclass(frozen=True, slots=True)
class WantParameters:
    """When a flagged voxel's Gaussian is asked for."""

    enough: int = setting(
        4,
        "So many measured Gaussians that may agree with it are enough; 0: none is ever asked for.",
        least=0,
    )
    sample: int = setting(
        32,
        "Where at least so many flags of a tile, and most of them, are outvoted, about so many of their "
        "Gaussians are asked for all the same: they cannot change the map, but they tell whether the "
        "vehicle's poses are off (`shift`); 0: none.",
        least=0,
    )

    def __post_init__(self) -> None:
        check_settings(self, MergerError)


@dataclass(frozen=True, slots=True)
class Known:
    """What the cloud holds about one tile.

    Attributes:
        epoch: Gaussians of the version that all reports are merged into.
        votes: of the reports of the windows that are not folded into it.
        bases: Gaussians by content hash of the versions that these reports and the new one refer to.
        promised: (K,) voxels of which Gaussians were asked of other vehicles just now; a voxel may occur several times.
        memory: of the windows before.
    """

    epoch: Gaussians
    votes: TileVotes = field(default_factory=TileVotes)
    bases: Mapping[bytes, Gaussians] = field(default_factory=dict)
    promised: I32 = field(default_factory=lambda: np.zeros(0, np.int32))
    memory: TileMemory = field(default_factory=TileMemory)


@dataclass(frozen=True, slots=True, eq=False)
class Wanted:
    """What is wanted of a report.

    Attributes:
        mask: (N,) bool for each new or modified voxel of the report, in order of tile and voxel id: whether to ask.
        hopeless: tiles of which it flags such voxels only, none is asked for, and none could win whatever it is.
    """

    mask: NDArray[np.bool_]
    hopeless: frozenset[TileId] = frozenset()


def wanted(report: ChangeReport, known: Mapping[TileId, Known], merge: MergeParameters, want: WantParameters) -> Wanted:
    """Which Gaussians of a report to ask for.

    Args:
        report: with its Gaussians withheld (`expanding.expand`) or not: they are not looked at.
        known: of at least those tiles of the report that have such voxels.
        merge: how the statements will be merged.
        want: when to ask.
    """
    parts, hopeless = [np.zeros(0, np.bool_)], set()
    for change in report.tiles:
        is_asked = is_askable(change)
        if is_asked.any():
            own = merge.report_of(report.report_id, report.sensor_model, change)
            may_win, ask = _wanted_of_tile(own, known[change.tile], merge, want)
            parts.append(ask)
            if is_asked.all() and not (may_win | ask).any():
                hopeless.add(change.tile)
    return Wanted(np.concatenate(parts), frozenset(hopeless))


def _wanted_of_tile(
    own: Report, known: Known, merge: MergeParameters, want: WantParameters
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Of each flagged voxel of a tile whether it may win the vote, and whether to ask for its Gaussian."""
    asked = is_askable(own.change)
    ids, modified = own.change.changed.voxel_id[asked], own.change.change_class[asked] == ChangeClass.MODIFIED
    bases = {} if merge.mode == "paper" else quotable(known.bases)
    votes, cast, in_hand = known.votes.about(ids, own.change.base_sha, bases, but=own.report_id)
    if merge.mode == "default":
        remembered = _remembered(own, known, ids)
        votes, cast, in_hand = votes + remembered[0], cast + remembered[1], in_hand + remembered[2]
    votes, cast, in_hand = votes + own.weight, cast + own.weight, in_hand + _promised(known.promised, ids)
    xi = np.where(modified & (merge.mode == "default"), MERGE_XI_RESHAPED, merge.xi)
    may_win = votes > WANT_SHARE * xi * cast
    asked_anyway = _sample(~may_win, 0 if merge.has_paper_rules else want.sample)
    return may_win, np.asarray((may_win & (in_hand < want.enough)) | asked_anyway)


def _remembered(own: Report, known: Known, ids: I32) -> tuple[NDArray[np.float64], ...]:
    """Of these voxels what the windows before say: votes that may agree with the flag, all votes, Gaussians in hand."""
    memory, n = known.memory, len(ids)
    may_agree, cast, in_hand = np.zeros((3, n))
    if not len(memory.voxels) + len(memory.claims):
        return may_agree, cast, in_hand
    was = states_at(known.bases.get(own.change.base_sha, Gaussians.empty()), ids, Kind.QUOTED)
    of_epoch = states_at(known.epoch, ids, Kind.QUOTED)
    is_epoch = same_state(was, of_epoch)
    cast += memory.support(ids, day_of(own.last_ns))
    may_agree += np.where((of_epoch["kind"] == Kind.QUOTED) & ~is_epoch, cast, 0.0)
    claims = memory.claims[find(ids, memory.claims["voxel_id"]) >= 0]
    seat = np.searchsorted(ids, claims["voxel_id"])
    quotes_the_denied = (claims["kind"] == Kind.QUOTED) & is_epoch[seat]
    agrees = (claims["kind"] != Kind.NOTHING) & ~quotes_the_denied
    same_was = is_epoch[seat] & ((claims["was"] == EPOCH) | (of_epoch["count"][seat] == 0))
    np.add.at(cast, seat, claims["weight"])
    np.add.at(may_agree, seat, claims["weight"] * agrees)
    np.add.at(in_hand, seat, agrees & (claims["kind"] == Kind.MEASURED) & same_was)
    return may_agree, cast, in_hand


def _sample(outvoted: NDArray[np.bool_], n: int) -> NDArray[np.bool_]:
    """About `n` of the marked ones, evenly; none where fewer are marked, or less than half."""
    rows, chosen = np.flatnonzero(outvoted), np.zeros(len(outvoted), bool)
    if n and len(rows) >= max(n, len(outvoted) / 2):
        chosen[rows[:: len(rows) // n]] = True
    return chosen


def _promised(promised: I32, ids: I32) -> NDArray[np.int64]:
    """(len(ids),) how often each of the sorted `ids` was asked of others."""
    known = promised[np.isin(promised, ids)]
    return np.bincount(np.searchsorted(ids, known), minlength=len(ids))


def asked_voxels(report: ChangeReport, mask: NDArray[np.bool_]) -> dict[TileId, I32]:
    """Of each tile the voxels that `mask` of `wanted` marks, sorted."""
    found: dict[TileId, I32] = {}
    first = 0
    for change in report.tiles:
        ids = _askable_ids(change)
        found[change.tile] = ids[mask[first : first + len(ids)]]
        first += len(ids)
    return found


def _askable_ids(change: TileChange) -> I32:
    return change.changed.voxel_id[is_askable(change)]
