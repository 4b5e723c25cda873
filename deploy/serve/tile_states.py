"""What each voxel of a version is, since when, and on whose word: the history of a tile, read once."""

import threading
from collections import OrderedDict
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import I64
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import diff
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.errors import UnknownVersion
from gnd.tile_store.store import Store
from gnd.tile_store.values import NS_PER_S, StoredTile

KEPT: Final = 512
"""So many versions are remembered."""
LONGEST: Final = 64
"""Of a tile so many versions are read at most; what is older counts as surveyed."""
AS_SURVEYED, NEW, CHANGED = 0, 1, 2


@dataclass(frozen=True, slots=True, eq=False)
class PageTile:
    """A version of a tile.

    Attributes:
        tile: which tile.
        version: its version.
        gaussians: N voxels.
        kind: (N,) `AS_SURVEYED`, `NEW` or `CHANGED` against the latest survey.
        since_s: (N,) POSIX seconds when each became what it is; 0: not known.
        since_version: (N,) in which version.
        reports: (N,) how many reports said so.
    """

    tile: TileId
    version: int
    gaussians: Gaussians
    kind: I64
    since_s: I64
    since_version: I64
    reports: I64


class TileStates:
    """Versions with the history of their voxels. May be asked from several threads.

    Args:
        store: to read.
        layer: of Gaussians.
    """

    def __init__(self, store: Store, layer: str) -> None:
        self._store, self._layer = store, layer
        self._kept: OrderedDict[tuple[TileId, int], PageTile] = OrderedDict()
        self._lock = threading.Lock()

    def state(self, tile: TileId, version: int) -> PageTile:
        """A version.

        Raises:
            UnknownVersion: there is none of that number.
        """
        known = self._known(tile, version)
        if known is not None:
            return known
        lines = [line.version for line in self._store.history(self._layer, tile) if line.version <= version]
        if not lines or lines[-1] != version:
            raise UnknownVersion(f"tile {tile} of layer {self._layer!r} has no version {version}")
        before: PageTile | None = None
        todo: list[int] = []
        for number in reversed(lines[-LONGEST:]):
            before = self._known(tile, number)
            if before is not None:
                break
            todo.append(number)
        for number in reversed(todo):
            before = self._next(tile, number, before)
            self._keep(before)
        assert before is not None
        return before

    def _next(self, tile: TileId, version: int, before: PageTile | None) -> PageTile:
        stored = self._store.get(self._layer, tile, version)
        if stored is None:
            raise UnknownVersion(f"tile {tile} of layer {self._layer!r} has no version {version}")
        gaussians = stored.decode_gaussians().gaussians
        if before is None or stored.kind == "base":
            return _surveyed(stored, gaussians)
        state = _merged(stored, gaussians, before, self._store.voxel_provenance(self._layer, tile, version))
        return state if stored.kind == "merged" else _given_back(state, self._survey(tile, version))

    def _survey(self, tile: TileId, version: int) -> PageTile | None:
        """The latest survey before a version."""
        lines = self._store.history(self._layer, tile)
        bases = [line.version for line in lines if line.kind == "base" and line.version < version]
        return self.state(tile, bases[-1]) if bases else None

    def _known(self, tile: TileId, version: int) -> PageTile | None:
        with self._lock:
            found = self._kept.get((tile, version))
            if found is not None:
                self._kept.move_to_end((tile, version))
            return found

    def _keep(self, state: PageTile) -> None:
        with self._lock:
            self._kept[state.tile, state.version] = state
            while len(self._kept) > KEPT:
                self._kept.popitem(last=False)


def _surveyed(stored: StoredTile, gaussians: Gaussians) -> PageTile:
    n = len(gaussians)
    measured_ns = stored.surveyed_ns if stored.surveyed_ns is not None else stored.created_ns
    return PageTile(
        stored.tile,
        stored.version,
        gaussians,
        np.full(n, AS_SURVEYED, np.int64),
        np.full(n, measured_ns // NS_PER_S, np.int64),
        np.full(n, stored.version, np.int64),
        np.zeros(n, np.int64),
    )


def _merged(
    stored: StoredTile, gaussians: Gaussians, before: PageTile, reports_of: dict[int, tuple[str, ...]]
) -> PageTile:
    """What changed gets the time of this version, all else keeps what was known of it."""
    delta = diff(before.gaussians, gaussians)
    ids = gaussians.voxel_id
    place = np.searchsorted(before.gaussians.voxel_id, ids)
    place = np.minimum(place, max(len(before.gaussians) - 1, 0))
    was_there = np.zeros(len(ids), bool)
    if len(before.gaussians):
        was_there = before.gaussians.voxel_id[place] == ids
    is_put = np.isin(ids, delta.put.voxel_id)
    told = np.array([len(reports_of.get(int(one), ())) for one in ids[is_put]], np.int64)
    columns = []
    for old, new in (
        (before.kind, np.where(was_there[is_put], CHANGED, NEW)),
        (before.since_s, np.full(int(is_put.sum()), stored.created_ns // NS_PER_S)),
        (before.since_version, np.full(int(is_put.sum()), stored.version)),
        (before.reports, told),
    ):
        column = old[place].copy() if len(old) else np.zeros(len(ids), np.int64)
        column[is_put] = new
        columns.append(column)
    kind, since_s, since_version, reports = columns
    if len(before.kind):  # what was new once and is changed again is still new since the survey
        kind[is_put & was_there & (before.kind[place] == NEW)] = NEW
    return PageTile(stored.tile, stored.version, gaussians, kind, since_s, since_version, reports)


def _given_back(state: PageTile, survey: PageTile | None) -> PageTile:
    """What a rollback has made as it was surveyed is as surveyed again."""
    if survey is None:
        return state
    ids = state.gaussians.voxel_id
    differs = np.isin(ids, diff(survey.gaussians, state.gaussians).put.voxel_id)
    is_back = np.isin(ids, survey.gaussians.voxel_id) & ~differs
    place = np.searchsorted(survey.gaussians.voxel_id, ids[is_back])
    told = {}
    for name in ("kind", "since_s", "since_version", "reports"):
        told[name] = getattr(state, name).copy()
        told[name][is_back] = getattr(survey, name)[place]
    return replace(state, **told)
