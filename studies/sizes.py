"""Bytes: what a tile, a change report and a notice of one change weigh with codec 0 (float32 columns)."""

import zlib

import numpy as np

from gnd.gnd_map.codec import encode_gaussians
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile, diff
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.report_id import deterministic_report_id
from gnd.schemas.tiles import blob_of
from gnd.schemas.updates import TileUpdate
from studies.frame.measure import Figure

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


def run() -> list[Figure]:
    """Measure encoded sizes on a synthetic tile; the codec has no entropy stage, so the content does not matter."""
    base = base_tile()
    voxels = len(base.gaussians)
    blob, report = blob_of(base).encode(), change_report(0, base).encode()
    after = base.gaussians.take(np.arange(CHANGED, voxels))
    update = TileUpdate(base.tile_id, "ndt", 2, 1, base.sha, base.sha, "merged", diff(base.gaussians, after)).encode()
    return [
        Figure("tile download", len(blob) / voxels, "B/voxel", f"{voxels} voxels, {len(blob)} B"),
        Figure("codec 0 alone", len(encode_gaussians(base.gaussians)) / voxels, "B/voxel"),
        Figure("the same, deflated", len(zlib.compress(blob)) / voxels, "B/voxel", "synthetic content: a lower bound"),
        Figure("change report", len(report) / CHANGED, "B/change", f"{CHANGED} changes, 500 observed, {len(report)} B"),
        Figure("update notice", len(update), "B", f"{CHANGED} voxels removed"),
    ]
