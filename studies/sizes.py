"""Bytes: what a tile, a change report and a notice of one change weigh with codec 0 (float32 columns)."""

import zlib

import numpy as np

from gnd.gnd_map.codec import encode_gaussians
from gnd.gnd_map.tile import diff
from gnd.schemas.tiles import blob_of
from gnd.schemas.updates import TileUpdate
from studies.flat_tile import CHANGED, base_tile, change_report
from studies.frame.measure import Figure


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
