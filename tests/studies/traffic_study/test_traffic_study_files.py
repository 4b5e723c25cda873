"""Point-cloud formats that the traffic study writes."""

import sys
from typing import Any

import numpy as np
import pytest

from gnd.gnd_map.tile_id import TileId
from studies.frame.errors import ReproduceError
from studies.traffic_study import clouds
from studies.traffic_study.clouds import (
    cloud_sizes,
    draco,
    laz,
    pcd_binary,
)


def some_points(n: int = 500) -> Any:
    rng = np.random.default_rng(1)
    return (rng.uniform(0.0, 30.0, (n, 3)) * [1.0, 1.0, 0.01]).astype(np.float32)


def test_pcd_files_hold_the_points() -> None:
    points = some_points()
    head, body = pcd_binary(points).split(b"DATA binary\n", 1)
    assert f"POINTS {len(points)}".encode() in head
    assert np.array_equal(np.frombuffer(body, "<f4").reshape(-1, 3), points)


def test_a_missing_library_leaves_a_row_that_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("laspy", "DracoPy"):
        monkeypatch.setitem(sys.modules, name, None)
    sizes = cloud_sizes({TileId(5): some_points()})
    assert sizes["pcd"] == len(pcd_binary(some_points()))
    assert "laspy" in str(sizes["laz"])
    assert "DracoPy" in str(sizes["draco"])
    with pytest.raises(ReproduceError, match="peers"):
        laz(some_points())


def test_laz_and_draco_hold_the_points_to_a_centimetre() -> None:
    laspy, draco_py = pytest.importorskip("laspy"), pytest.importorskip("DracoPy")
    pytest.importorskip("lazrs")
    import io

    points = some_points()
    with laspy.open(io.BytesIO(laz(points))) as file:
        read = file.read().xyz
    assert np.abs(read - points).max() <= clouds.LAZ_STEP_M / 2 + 1e-6
    body = draco(points)
    found = np.asarray(draco_py.decode(body).points)
    step_m = np.ptp(points, axis=0).max() / (2**clouds.DRACO_BITS - 1)
    assert len(found) == len(points)
    assert np.abs(np.sort(found, axis=0) - np.sort(points, axis=0)).max() <= step_m
    assert len(body) < len(pcd_binary(points)) / 2
