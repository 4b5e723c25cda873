"""A tile and a report that no vehicle made: for studies of service, where their content does not matter."""

import numpy as np

from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.report_id import deterministic_report_id

TILE = TileId(497353963154)
VOXELS = 2_000
CHANGED = 40
_T0_MS = 1_700_000_000_000


def base_tile(voxels: int = VOXELS) -> Tile:
    """Return a tile of flat Gaussians on the ground floor."""
    voxel_id = np.arange(-voxels // 2, voxels // 2, dtype=np.int32)
    cov = np.tile(np.array([0.08, 0, 0, 0.08, 0, 0.0009], np.float32), (voxels, 1))
    full = np.full(voxels, 200, np.int32), np.full(voxels, 60, np.int32)
    return Tile(TILE, 1, Gaussians(voxel_id, *full, np.zeros((voxels, 3), np.float32), cov))


def change_report(number: int, base: Tile) -> ChangeReport:
    """Return one vehicle's report about one tile: 500 voxels observed, 40 of them changed."""
    observed = base.gaussians.voxel_id[:500]
    changed = base.gaussians.take(np.arange(CHANGED))
    change = TileChange(
        tile=TILE,
        base_version=1,
        base_sha=base.sha,
        observed=observed,
        changed=changed,
        change_class=np.full(CHANGED, 2, np.uint8),
        evidence=np.full((CHANGED, 4), 9, np.int32),
        pose_sigma_m=0.03,
        pose_sigma_rad=0.001,
    )
    return ChangeReport(
        report_id=deterministic_report_id(_T0_MS + number, "benchmark"),
        vehicle=f"bench-{number % 100}",
        sensor_model="VLP-16",
        software="benchmark",
        district=TILE.district,
        first_ns=_T0_MS * 1_000_000,
        last_ns=_T0_MS * 1_000_000 + 1,
        tiles=(change,),
    )
