"""All feature tiles that came along a drive, in its map frame: a graph over a whole stretch needs those left behind."""

from collections.abc import Iterable
from itertools import groupby, pairwise
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features import CUT_START, Feature, FeatureTile
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.features.feature_map import features_in_map
from gnd.vehicle_agent.features.layer_parameters import LANES
from gnd.vehicle_agent.features.look import MapFeatures
from gnd.vehicle_agent.features.mapping.lane_map import LaneMap

LEAST_LANE_M: Final = 5.0
"""Shorter pieces of a lane give no direction."""


class HeldMap:
    """Tiles by layer, the newest version of each.

    Args:
        frame: the map frame.
    """

    def __init__(self, frame: LocalFrame) -> None:
        self.frame = frame
        self._tiles: dict[str, dict[TileId, FeatureTile]] = {}

    def put(self, layer: str, tile_id: TileId, tile: FeatureTile | None) -> None:
        """Keep a tile; None = the store has none, and what was kept goes."""
        tiles = self._tiles.setdefault(layer, {})
        if tile is None:
            tiles.pop(tile_id, None)
        else:
            tiles[tile_id] = tile

    def tiles(self, layer: str) -> dict[TileId, FeatureTile]:
        """The tiles of a layer."""
        return self._tiles.get(layer, {})

    def known(self, layer: str, kinds: Iterable[str] = ()) -> MapFeatures:
        """The point features of a layer, of these kinds; none named = all."""
        found = [features_in_map(self.frame, tile, kinds) for _, tile in sorted(self.tiles(layer).items())]
        if not found:
            return MapFeatures.none()
        return MapFeatures(
            np.concatenate([one.feature_id for one in found]),
            tuple(kind for one in found for kind in one.kind),
            np.concatenate([one.xy_m for one in found]),
            np.concatenate([one.z_m for one in found]),
            np.concatenate([one.cov for one in found]),
        )

    def lanes(self) -> LaneMap | None:
        """The polylines of the layer "lanes", as far as their tiles have come; None = the map has none here."""
        pieces = [
            (tile_id, one) for tile_id, tile in self.tiles(LANES).items() for one in tile.features if not one.is_point
        ]
        pieces.sort(key=lambda piece: piece[1].key)
        lines = [
            line
            for _, one in groupby(pieces, key=lambda piece: piece[1].feature_id)
            for line in self._joined(list(one))
        ]
        long = [line for line in lines if np.linalg.norm(np.diff(line, axis=0), axis=1).sum() >= LEAST_LANE_M]
        return LaneMap.of(long) if long else None

    def _joined(self, pieces: list[tuple[TileId, Feature]]) -> list[F64]:
        """The lines (N, 2) of one feature's pieces; a piece that has not come breaks the line."""
        lines = [[self._in_map(*pieces[0])]]
        for (_, before), (tile_id, piece) in pairwise(pieces):
            if piece.part != before.part + 1:
                lines.append([])
            line = self._in_map(tile_id, piece)
            lines[-1].append(line[1:] if lines[-1] and (piece.cuts & CUT_START or piece.part) else line)
        return [np.concatenate(line) for line in lines]

    def _in_map(self, tile_id: TileId, piece: Feature) -> F64:
        T = self.frame.T_self_other(LocalFrame.of_tile(tile_id))
        return (piece.points_m @ T[:3, :3].T + T[:3, 3])[:, :2]
