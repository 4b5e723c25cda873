"""Small tiles and what vehicles say about them."""

import numpy as np

from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.report_id import deterministic_report_id

TILE = TileId(497353963154)


def at(voxel_ids: list[int], up_m: float = 0.0) -> Gaussians:
    n = len(voxel_ids)
    cov = np.tile(np.array([0.08, 0, 0, 0.08, 0, 0.0009], np.float32), (n, 1))
    mean = np.tile(np.array([0, 0, up_m], np.float32), (n, 1))
    count = np.full(n, 100, np.int32)
    return Gaussians(np.array(voxel_ids, np.int32), count, count, mean, cov)


def change(observed: list[int], changed: Gaussians, *, withheld: bool = False) -> TileChange:
    n = len(changed)
    return TileChange(
        tile=TILE,
        base_version=1,
        base_sha=b"\x01" * 32,
        observed=np.array(observed, np.int32),
        changed=changed,
        change_class=np.where(changed.exists | withheld, ChangeClass.MODIFIED, ChangeClass.DELETED).astype(np.uint8),
        evidence=np.zeros((n, 4), np.int32),
        pose_sigma_m=0.0,
        pose_sigma_rad=0.0,
    )


def report_of(vehicle: str, said: TileChange, last_ns: int) -> ChangeReport:
    """A vehicle's report of one tile, from a drive of ten seconds."""
    report_id = deterministic_report_id(last_ns // 1_000_000, vehicle)
    return ChangeReport(report_id, vehicle, "VLP-16", "test", said.tile.district, last_ns - 10**10, last_ns, (said,))
