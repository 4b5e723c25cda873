"""What parks is no change: new things with the shape of a vehicle are published only when they have stood for long.

However many vehicles meet a parked car within an hour, they have met it once. So what has the shape of a vehicle
(`gnd.gnd_map.vehicle_shape`) waits until it was seen again after `parked_h`, and nobody has seen the place free in
between. A place where such things have come and gone is a parking place: each going doubles the time, and whatever
comes next there waits, whatever its shape. A container that stands for weeks arrives all the same.

A pure function of the state before the window and of the set of its reports, as the merge itself.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from gnd.cloud_merger.confirmation import seen_of
from gnd.cloud_merger.memory import PARKED, ParkedVoxels
from gnd.cloud_merger.merge import MergedTile
from gnd.cloud_merger.statements import Kind, Report, changed_of, find
from gnd.gnd_map.arrays import I32, I64, are_in, unique
from gnd.gnd_map.beside import groups_of
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile_id import TileId
from gnd.gnd_map.vehicle_shape import has_vehicle_shape
from gnd.tile_store.values import Unconfirmed, WaitingReason

PARKED_MOST_H: Final = 14 * 24.0
"""No place is so much of a parking place that what stands there for two weeks is not published."""
PARKED_PLACE_GOINGS: Final = 2
"""So often something must have gone from a voxel until whatever comes there is taken for a vehicle."""
PARKED_SEEN_SHARE: Final = 0.2
"""A report speaks about a thing when it observed at least this share of its voxels."""
PARKED_THERE_SHARE: Final = 0.5
"""Of those it must hold at least this share to have seen the thing, ..."""
PARKED_FREE_SHARE: Final = 0.2
"""... and at most this share to have seen that it is gone."""
PARKED_FREE_WEIGHT: Final = 0.75
"""A report whose vote weighs less (few layers, poor poses) does not tell that a place is free: it misses things."""
MOST_GOINGS: Final = 255
_NS_PER_H: Final = 3600 * 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class ParkedTile:
    """A tile without what parks.

    Attributes:
        merged: the tile to publish.
        voxels: those that are held back: PARKED, sorted by voxel.
        waiting: who claims them.
    """

    merged: MergedTile
    voxels: ParkedVoxels = field(default_factory=lambda: np.zeros(0, PARKED))
    waiting: tuple[Unconfirmed, ...] = ()


def hold_parked(
    epoch: Gaussians,
    merged: MergedTile,
    reports: Sequence[Report],
    before: ParkedVoxels,
    bases: Mapping[bytes, Gaussians],
    parked_h: float,
) -> ParkedTile:
    """Take back what has the shape of a vehicle and has not yet stood for long.

    Args:
        epoch: the tile that the reports were merged into.
        merged: of `merge_tile`.
        reports: those of the merge, in any order.
        before: what parked when the windows before this one were closed.
        bases: Gaussians of the tile's versions by hash.
        parked_h: so long, in hours, a thing must have stood at a place from which nothing has gone yet; 0: whatever is
            new is published.
    """
    tile = next((one.change.tile for one in reports), None)
    new = merged.delta.put.take(np.flatnonzero(~are_in(merged.delta.put.voxel_id, epoch.voxel_id)))
    if parked_h <= 0.0 or tile is None or not len(new):
        return ParkedTile(merged)
    things = _things(tile, epoch, new, before)
    spoken = [_Spoken.of(one, bases) for one in sorted(reports, key=lambda one: one.turn)] if things else []
    held = []
    for group in things:
        since_ns, until_ns, went = _stood(group, before, spoken)
        goings = np.minimum(_goings(group, before) + went, MOST_GOINGS)
        needed_h = min(parked_h * 2.0 ** int(np.median(goings)), PARKED_MOST_H)
        if until_ns - since_ns < needed_h * _NS_PER_H:
            held.append(_rows(group, since_ns, goings))
    if not held:
        return ParkedTile(merged)
    voxels = np.concatenate(held)
    voxels = voxels[np.argsort(voxels["voxel_id"])]
    return ParkedTile(
        merged.without(voxels["voxel_id"].tolist()),
        voxels,
        waiting_of(voxels["voxel_id"], merged, epoch, reports, "parked"),
    )


def parked_after(
    before: ParkedVoxels,
    held: ParkedVoxels,
    published: I32,
    reports: Sequence[Report],
    bases: Mapping[bytes, Gaussians],
) -> ParkedVoxels:
    """What a tile remembers of parked things when a window is closed.

    Args:
        before: what it remembered.
        held: what the window holds back.
        published: the voxels that hold something now.
        reports: of the window.
        bases: Gaussians of the tile's versions by hash.
    """
    if not len(before):
        return held
    rest = before[~are_in(before["voxel_id"], held["voxel_id"])].copy()
    rest["since_ns"][are_in(rest["voxel_id"], published)] = 0  # no longer parked: it is the map
    newest = np.full(len(rest), -1, np.int8)
    for spoken in (_Spoken.of(one, bases) for one in sorted(reports, key=lambda one: one.turn)):
        seen = are_in(rest["voxel_id"], spoken.observed) & (spoken.at_ns >= rest["since_ns"])
        if not spoken.tells_free:
            seen &= are_in(rest["voxel_id"], spoken.there)
        newest[seen] = are_in(rest["voxel_id"][seen], spoken.there)
    gone = (newest == 0) & (rest["since_ns"] > 0)
    rest["goings"][gone] = np.minimum(rest["goings"][gone].astype(int) + 1, MOST_GOINGS)
    rest["since_ns"][gone] = 0
    kept = np.concatenate([rest[(rest["since_ns"] > 0) | (rest["goings"] > 0)], held])
    found: ParkedVoxels = kept[np.argsort(kept["voxel_id"])]
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Spoken:
    """What a report says of any voxel: those it observed, and those that hold something by its word; sorted ids."""

    at_ns: int
    tells_free: bool
    observed: I32
    there: I32

    @classmethod
    def of(cls, report: Report, bases: Mapping[bytes, Gaussians]) -> "_Spoken":
        changed = changed_of(report.change)
        ids = changed.rows["voxel_id"]
        there = ids[changed.speaks & (changed.rows["kind"] != Kind.NOTHING)]
        unchanged = report.change.observed[~are_in(report.change.observed, ids)]
        base = bases.get(report.change.base_sha, Gaussians.empty()).voxel_id
        met = report.change.unsure.voxel_id
        observed = unique(np.concatenate([unchanged, ids[changed.speaks], met]))
        there = unique(np.concatenate([there, unchanged[are_in(unchanged, base)], met]))
        return cls(report.last_ns, report.weight >= PARKED_FREE_WEIGHT, observed, there)


def _things(tile: TileId, epoch: Gaussians, new: Gaussians, before: ParkedVoxels) -> list[I32]:
    """Sorted ids of the voxels of each thing that may be parked."""
    grid = VoxelGrid.of(tile)
    is_parked = has_vehicle_shape(grid, epoch, new)
    is_place = are_in(new.voxel_id, before["voxel_id"][before["goings"] >= PARKED_PLACE_GOINGS])
    index = np.stack(grid.unravel(new.voxel_id), axis=1)
    for group in groups_of(index, np.arange(len(new))):
        if is_place[group].mean() >= PARKED_THERE_SHARE:
            is_parked[group] = True
    return [np.sort(new.voxel_id[group]) for group in groups_of(index, np.flatnonzero(is_parked))]


def _stood(group: I32, before: ParkedVoxels, spoken: Iterable[_Spoken]) -> tuple[int, int, int]:
    """When a thing was first and last seen without a break, UTC ns, 0 where it was not seen; and how often it went."""
    remembered = before["since_ns"][are_in(before["voxel_id"], group)]
    remembered = remembered[remembered > 0]
    since = int(np.median(remembered)) if 2 * len(remembered) >= len(group) else None
    until, went = since, 0
    for one in spoken:
        seen = group[are_in(group, one.observed)]
        if not len(seen) or len(seen) < PARKED_SEEN_SHARE * len(group):
            continue
        share = float(are_in(seen, one.there).mean())
        if share >= PARKED_THERE_SHARE:
            since, until = one.at_ns if since is None else min(since, one.at_ns), one.at_ns
        elif share <= PARKED_FREE_SHARE and one.tells_free and (since is None or one.at_ns >= since):
            went += since is not None
            since = until = None
    return (0, 0, went) if since is None or until is None else (since, until, went)


def _goings(group: I32, before: ParkedVoxels) -> I64:
    at = find(before["voxel_id"], group)
    return np.where(at >= 0, np.append(before["goings"], 0)[at], 0).astype(np.int64)


def _rows(group: I32, since_ns: int, goings: I64) -> ParkedVoxels:
    rows = np.zeros(len(group), PARKED)
    rows["voxel_id"], rows["since_ns"], rows["goings"] = group, since_ns, goings
    return rows


def waiting_of(
    voxels: I32, merged: MergedTile, epoch: Gaussians, reports: Sequence[Report], reason: WaitingReason
) -> tuple[Unconfirmed, ...]:
    """What waits, told of the vehicle whose report about it comes first."""
    vehicle = {one.report_id: one.vehicle for one in reports}
    claims: dict[str, list[tuple[str, ...]]] = {}
    for voxel in voxels.tolist():
        ids = merged.provenance[voxel]
        first = min((vehicle[one] for one in ids if one in vehicle), default="")
        claims.setdefault(first, []).append(ids)
    return tuple(
        Unconfirmed(name, tuple(sorted({one for ids in claimed for one in ids})), len(claimed),
                    max(seen_of(name, epoch, reports), len(claimed)), reason)
        for name, claimed in sorted(claims.items())
    )  # fmt: skip
