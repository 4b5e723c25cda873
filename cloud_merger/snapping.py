"""Merged tiles on their lattice: what a tile's last merge has decided alike is neither rounded nor put together anew.

What is remembered changes no bit: each Gaussian is snapped by itself, and taken from memory only where it is the same
to the bit.
"""

from collections import OrderedDict
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.merge import MergedTile
from gnd.cloud_merger.statements import find
from gnd.gnd_map.by_object import ByObject
from gnd.gnd_map.codec import Lattice, is_on, snap
from gnd.gnd_map.gaussian import Gaussians, concat
from gnd.gnd_map.tile import TileDelta, apply
from gnd.gnd_map.tile_id import TileId

REMEMBERED_TILES: Final = 1024
Bits = NDArray[np.uint8]
_ON: Final[ByObject[bool]] = ByObject(REMEMBERED_TILES)


@dataclass(frozen=True, slots=True, eq=False)
class _Last:
    """The last merge of a tile: its changes as they were decided, their bits, and on the lattice; the whole tile."""

    epoch: Gaussians
    lattice: Lattice
    delta: TileDelta
    bits: Bits
    snapped: Gaussians
    tile: Gaussians


class Snapping:
    """Snaps merged tiles, those merged last with less work. Not safe in several threads."""

    def __init__(self, most: int = REMEMBERED_TILES) -> None:
        self._most = most
        self._held: OrderedDict[TileId, _Last] = OrderedDict()  # newest last

    def of(self, tile: TileId, merged: MergedTile, lattice: Lattice) -> Gaussians:
        """The merged tile on the lattice, the same bits as `snap(merged.gaussians, lattice)`; the very object of the
        last merge where nothing is decided otherwise.
        """
        if not _ON.of(merged.epoch, lambda: is_on(merged.epoch, lattice), lattice.code):
            return snap(merged.gaussians, lattice)
        last, bits = self._held.get(tile), _bits(merged.delta.put)
        if last is not None and (last.epoch is not merged.epoch or last.lattice is not lattice):
            last = None
        if last is not None and np.array_equal(last.bits, bits):
            ids = last.delta.put.voxel_id, last.delta.removed
            if all(map(np.array_equal, ids, (merged.delta.put.voxel_id, merged.delta.removed))):
                return last.tile
        snapped = _snapped(merged.delta.put, bits, last, lattice)
        found = apply(merged.epoch, TileDelta(merged.delta.removed, snapped))
        self._held[tile] = _Last(merged.epoch, lattice, merged.delta, bits, snapped, found)
        self._held.move_to_end(tile)
        if len(self._held) > self._most:
            self._held.popitem(last=False)
        return found


def _bits(gaussians: Gaussians) -> Bits:
    """(N, 44) all that is said of each voxel: -0.0 is not 0.0 here."""
    columns = (np.ascontiguousarray(one).view(np.uint8).reshape(len(gaussians), -1) for one in gaussians.columns[1:])
    return np.concatenate(list(columns), axis=1) if len(gaussians) else np.zeros((0, 44), np.uint8)


def _snapped(put: Gaussians, bits: Bits, last: _Last | None, lattice: Lattice) -> Gaussians:
    """The Gaussians on the lattice, those from memory that the last merge has decided, too."""
    if last is None or not len(put) or not len(last.snapped):
        return snap(put, lattice)
    at = find(last.delta.put.voxel_id, put.voxel_id)
    same = (at >= 0) & (last.bits[at] == bits).all(axis=1)
    if not same.any():
        return snap(put, lattice)
    kept = last.snapped.take(at[same])
    return kept if same.all() else concat([kept, snap(put.take(~same), lattice)])
