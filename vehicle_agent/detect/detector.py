"""Rays of many scans against the local map: counters while driving, each tile's evidence when it is left."""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.arrays import F64, I32, points_3d
from gnd.gnd_map.errors import ShapeError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.detect.evidence import TileEvidence
from gnd.vehicle_agent.detect.kernel import CERTAIN, cast_rays, kernel_parameters, window_affine
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.detect.records import N_BI, N_BO, N_PI, N_PO, Records, make_records
from gnd.vehicle_agent.detect.uncertainty import PoseUncertainty, TileUncertainties, poses_step
from gnd.vehicle_agent.errors import MapChanged
from gnd.vehicle_agent.local_map import EMPTY, UNKNOWN, LocalMap


@dataclass(slots=True)
class _VoxelWindow:
    """The dense window of one generation of the local map with everything counted so far."""

    generation: int
    origin_g: NDArray[np.int64]
    anchor_m: F64
    state: I32
    records: Records
    rows: dict[TileId, slice]
    tiles: dict[TileId, Tile]


class ChangeDetector:
    """Counts the six cases of GND section 4.2 over scans; order of scans does not matter.

    The map of a tile may not change while there is evidence about it: `touched` is true then, `finish` takes
    it out.
    """

    def __init__(self, local_map: LocalMap, parameters: DetectParameters | None = None) -> None:
        self.local_map = local_map
        self.parameters = parameters or DetectParameters()
        self._points = VoxelAccumulator(local_map.grid_frame)
        self._poses = TileUncertainties(local_map.grid_frame)
        self._window: _VoxelWindow | None = None
        self._sees_heights = False

    def add_scan(
        self,
        points_map_m: F64,
        origins_map_m: F64,
        moving: NDArray[np.bool_] | None = None,
        pose: PoseUncertainty = CERTAIN,
        *,
        sees_heights: bool = True,
    ) -> int:
        """Count the rays of one scan.

        Args:
            points_map_m: (N, 3) float64 hits, map frame, in firing order (shuffled points cost 1.5 times the time).
            origins_map_m: (N, 3) the sensor at each point, or (3,) for all.
            moving: (N,) bool, points on moving objects ([50] in GND): their rays pass, their ends count for nothing.
            pose: how well the scan's pose is known; it softens the evidence of its rays.
            sees_heights: False for a scan of a few level layers (`gnd.vehicle_agent.localise.level`).

        Returns:
            How many rays were cast.

        Raises:
            ShapeError: a wrong shape or a value that is not finite; nothing is counted then.
            MapChanged: a tile was replaced while there is evidence about it.
        """
        points = points_3d("points_map_m", points_map_m)
        origins = points_3d("origins_map_m", np.atleast_2d(origins_map_m))
        if len(origins) not in (1, len(points)):
            raise ShapeError(f"{len(origins)} sensor origins for {len(points)} points: one each, or one for all")
        moves = np.zeros(len(points), np.bool_) if moving is None else np.ascontiguousarray(moving, np.bool_)
        if moves.shape != (len(points),):
            raise ShapeError(f"moving has shape {moves.shape} for {len(points)} points: one truth value each")
        window = self._current()
        if not len(points) or not window.state.size:
            return 0
        self._sees_heights |= sees_heights
        middle = 0.5 * (origins[0] + origins[-1])
        affine = self.local_map.grid_frame.affine(middle)
        A, b = window_affine(*affine, window.anchor_m, window.origin_g)
        kept = np.zeros(len(points), np.uint8)
        cast = cast_rays(
            points, origins, window.anchor_m, A, b, window.state.reshape(-1), window.state.shape,
            window.records.words, window.records.floats, window.records.block,
            kernel_parameters(self.parameters, pose), moves, kept,
        )  # fmt: skip
        self._points.add_marked(points, kept)
        evidence = np.flatnonzero(kept)
        self._poses.add_scan(points[evidence[:: poses_step(len(evidence))]], len(evidence), middle, affine, pose)
        return cast

    def touched(self, tile_id: TileId) -> bool:
        """Whether there is evidence about a voxel of this tile."""
        window = self._current()
        return tile_id in window.tiles and self._is_touched(window, tile_id)

    def touched_tiles(self) -> tuple[TileId, ...]:
        """The tiles with evidence, sorted."""
        window = self._current()
        return tuple(tile_id for tile_id in sorted(window.tiles) if self._is_touched(window, tile_id))

    def finish(self, tiles: Collection[TileId]) -> dict[TileId, TileEvidence]:
        """Take out the evidence of tiles that are held by the map; afterwards there is none about them."""
        window = self._current()
        held = sorted(set(tiles) & set(window.tiles))
        measured = self._points.pop(held, n_min_cells=1)
        of_passes = self._poses.mean()
        return {t: self._take(window, t, measured.get(t, Gaussians.empty()), of_passes) for t in held}

    def _current(self) -> _VoxelWindow:
        """The window of the map as it is now; counters move along when the map has changed."""
        if self._window is None or self._window.generation != self.local_map.generation:
            fresh = self._fresh_window()
            if self._window is not None:
                self._carry_over(self._window, fresh)
            self._window = fresh
        return self._window

    def _fresh_window(self) -> _VoxelWindow:
        held = self.local_map
        anchor_m = held.mean_map_m.mean(axis=0) if held.count else np.zeros(3)
        return _VoxelWindow(
            generation=held.generation,
            origin_g=held.window_origin_g,
            anchor_m=anchor_m,
            state=held.index.copy(),
            records=self._records(anchor_m),
            rows=held.tile_rows,
            tiles={t: tile for t in held.tiles if (tile := held.tile(t)) is not None},
        )

    def _records(self, anchor_m: F64) -> Records:
        """Records of all Gaussians about an anchor; those of tiles that the window holds already are taken from it."""
        held, old, fresh = self.local_map, self._window, np.ones(self.local_map.count, np.bool_)
        known = [] if old is None else [t for t in old.tiles if old.tiles[t] is held.tile(t)]
        for tile_id in known:
            fresh[held.tile_rows[tile_id]] = False
        records = Records.of(len(fresh))
        records.put(fresh, make_records(held.mean_map_m[fresh], held.cov_m2[fresh], anchor_m, self.parameters))
        for tile_id in known:
            assert old is not None
            rows = held.tile_rows[tile_id]
            records.put(rows, old.records.taken(old.rows[tile_id], held.mean_map_m[rows] - anchor_m))
        return records

    def _carry_over(self, old: _VoxelWindow, new: _VoxelWindow) -> None:
        """Copy pass counters of the voxels and counters of the Gaussians that both windows hold."""
        for tile_id, tile in old.tiles.items():
            if new.tiles.get(tile_id) is tile:
                new.records.words[new.rows[tile_id], N_BI:] = old.records.words[old.rows[tile_id], N_BI:]
            elif self._is_touched(old, tile_id):
                raise MapChanged(
                    f"tile {tile_id} version {tile.version} was replaced or removed while there is evidence about it;"
                    " finish the tile first"
                )
        before, after = _overlap(old, new)
        np.copyto(after, before, where=(before < 0) & (before != UNKNOWN) & (after == EMPTY))

    def _is_touched(self, window: _VoxelWindow, tile_id: TileId) -> bool:
        if window.records.words[window.rows[tile_id], N_BI:].any():
            return True
        state = self._columns(window, tile_id)
        return bool(((state < EMPTY) & (state != UNKNOWN)).any())

    def _columns(self, window: _VoxelWindow, tile_id: TileId) -> I32:
        """(nx, ny, nz) view of the tile's part of the window."""
        x, y = self.local_map.box_of(tile_id, window.origin_g)
        return window.state[x, y]

    def _take(
        self, window: _VoxelWindow, tile_id: TileId, measured: Gaussians, of_passes: PoseUncertainty
    ) -> TileEvidence:
        """The tile's evidence; its counters are set back to zero."""
        tile = window.tiles[tile_id]
        passes = self._take_passes(window, tile_id)
        counters = window.records.words[window.rows[tile_id], N_BI:].copy()
        window.records.words[window.rows[tile_id], N_BI:] = 0
        seen = tile.gaussians.voxel_id[counters.any(axis=1)]
        found = tile_evidence(tile, counters, passes, np.union1d(seen, measured.voxel_id), measured)
        pose = self._poses.pop(tile_id) or of_passes
        return replace(found, pose=pose, at_one_height=not self._sees_heights)

    def _take_passes(self, window: _VoxelWindow, tile_id: TileId) -> tuple[I32, I32]:
        """Voxel ids and pass counts of the tile's empty voxels that rays crossed."""
        state = self._columns(window, tile_id)
        at = np.nonzero((state < EMPTY) & (state != UNKNOWN))
        n_pe = EMPTY - state[at]
        state[at] = EMPTY
        x, y = self.local_map.box_of(tile_id, window.origin_g)
        g = np.stack(at, axis=1) + window.origin_g + [x.start, y.start, 0]
        _, voxel_id = self.local_map.grid_frame.tile_voxel_of(g)
        return voxel_id, n_pe


def _overlap(old: _VoxelWindow, new: _VoxelWindow) -> tuple[I32, I32]:
    """Views of the voxels that both windows hold."""
    low = np.maximum(old.origin_g, new.origin_g)
    high = np.maximum(low, np.minimum(old.origin_g + old.state.shape, new.origin_g + new.state.shape))
    return _part(old, low, high), _part(new, low, high)


def _part(window: _VoxelWindow, low: NDArray[np.int64], high: NDArray[np.int64]) -> I32:
    (x0, y0, z0), (x1, y1, z1) = low - window.origin_g, high - window.origin_g
    return window.state[x0:x1, y0:y1, z0:z1]


def tile_evidence(
    tile: Tile, counters: I32, passes: tuple[I32, I32], blocked_or_seen: I32, measured: Gaussians
) -> TileEvidence:
    """Bring the counters of one tile together by voxel.

    Args:
        tile: the map that the rays were compared with.
        counters: (M, 4) BI, BO, PI, PO of the tile's Gaussians, in the order of their voxel ids.
        passes: ids (E,) and pass counts (E,) of its empty voxels that were crossed.
        blocked_or_seen: (B,) ids of the other voxels that rays touched.
        measured: the points that ended in the tile's voxels.
    """
    voxel_id = np.union1d(blocked_or_seen, passes[0]).astype(np.int32)
    row = _find(tile.gaussians.voxel_id, voxel_id)
    at = counters[row] if len(counters) else np.zeros((len(row), 4), np.int32)  # an unmapped tile has no Gaussians
    of_map = np.where((row >= 0)[:, None], at, 0).astype(np.int32)
    new = _spread(measured, voxel_id)
    return TileEvidence(
        base=tile,
        voxel_id=voxel_id,
        map_row=row,
        n_bi=of_map[:, N_BI - N_BI],
        n_bo=of_map[:, N_BO - N_BI],
        n_pi=of_map[:, N_PI - N_BI],
        n_po=of_map[:, N_PO - N_BI],
        n_be=np.where(row < 0, new.count, 0).astype(np.int32),
        n_pe=_scatter(voxel_id, *passes),
        measured=new,
    )


def _find(sorted_ids: I32, wanted: I32) -> NDArray[np.int64]:
    """(K,) position of each wanted id, -1 where it is absent."""
    at = np.minimum(np.searchsorted(sorted_ids, wanted), max(len(sorted_ids) - 1, 0))
    found = sorted_ids[at] == wanted if len(sorted_ids) else np.zeros(len(wanted), np.bool_)
    return np.where(found, at, -1).astype(np.int64)


def _scatter(voxel_id: I32, ids: I32, counts: I32) -> I32:
    """(K,) counts at the places of `ids`, zero elsewhere."""
    result = np.zeros(len(voxel_id), np.int32)
    result[np.searchsorted(voxel_id, ids)] = counts
    return result


def _spread(measured: Gaussians, voxel_id: I32) -> Gaussians:
    """(K,) the measured Gaussians at the places of their ids, nothing elsewhere."""
    at = np.searchsorted(voxel_id, measured.voxel_id)
    result = Gaussians.nothing_at(voxel_id)
    for column, values in zip(result.columns[1:], measured.columns[1:], strict=True):
        column[at] = values
    return result
