"""Uploads through the vehicle's sender to the cloud in this process: what is booked, merged, refused."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gnd.cloud_merger.merge import MergeParameters
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.codec import LATTICES, snap
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId
from gnd.gnd_map.track import STEPS, Track, TrackPiece, TrackView
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.report_id import deterministic_report_id
from gnd.vehicle_agent.report.packing import pack
from gnd.vehicle_agent.report.reporter import on_lattice
from studies.frame.errors import ReproduceError
from studies.simulation.base_map import BaseMap
from studies.simulation.result import EVIDENCE, VehicleResult
from studies.traffic_study.uploads import UploadCloud, upload

TILE = TileId(497353963154)
DRIVE_M = 500.0


def grounds(ids: list[int], height_m: float) -> Gaussians:
    n = len(ids)
    mean = np.tile(np.float32([0.0, 0.0, height_m]), (n, 1))
    cov = np.tile(np.float32([0.08, 0.0, 0.0, 0.08, 0.0, 0.0005]), (n, 1))
    return Gaussians(np.array(ids, np.int32), np.full(n, 200, np.int32), np.full(n, 60, np.int32), mean, cov)


BASE = snap(grounds(list(range(6)), -0.2), LATTICES["standard"])


def report_of(number: int, base: BaseMap, evidence: int = 5) -> ChangeReport:
    """Voxel 0 is modified, voxel 1 is gone, voxels 10 and 11 are new, all else is as it was."""
    states = [grounds([0], 0.25), Gaussians.nothing_at(np.array([1], np.int32)), grounds([10, 11], 0.0)]
    columns = zip(*(state.columns for state in states), strict=True)
    change = TileChange(
        tile=TILE,
        base_version=base.version(TILE),
        base_sha=base.shas[TILE],
        observed=np.array([0, 1, 2, 3, 4, 5, 10, 11], np.int32),
        changed=Gaussians(*(np.concatenate(column) for column in columns)),
        change_class=np.array([ChangeClass.MODIFIED, ChangeClass.DELETED, ChangeClass.NEW, ChangeClass.NEW], np.uint8),
        evidence=np.full((4, 4), evidence, np.int32),
        pose_sigma_m=0.03,
        pose_sigma_rad=0.001,
    )
    return ChangeReport(
        report_id=deterministic_report_id(1_000 * number, str(number)),
        vehicle=f"vehicle-{number:02d}",
        sensor_model="VLP-16",
        software="test",
        district=TILE.district,
        first_ns=1_000_000_000 * number + 1,
        last_ns=1_000_000_000 * number + 2,
        tiles=(on_lattice(change),),
    )


def track() -> Track:
    """Past the middle of the tile, near the ground."""
    first = TileId(TILE.district.first_morton)
    x, y = STEPS * (TILE.lon_index - first.lon_index), STEPS * (TILE.lat_index - first.lat_index) + STEPS // 2
    piece = TrackPiece(np.array([[x, y, 4], [x + STEPS, y, 4]], np.int32), 40)
    return Track(TILE.district, TrackView((-30, -24, -18, -12, -6, 0, 6, 12, 20)), (piece,))


def result_of(report: ChangeReport, base: BaseMap, packed: bytes | None = None) -> VehicleResult:
    stats: dict[str, Any] = {"way_m": DRIVE_M, "scans": 100, "pcd_bytes": {}}
    half = pack(report, {base.shas[TILE]: base.tiles[TILE]}, track()).encode() if packed is None else packed
    evidence = {name: np.zeros(0, np.int32) for name in EVIDENCE}
    rows = np.zeros(0, np.int32)
    return VehicleResult(report.vehicle, "vlp16", (report.encode(),), rows, evidence, stats, packed=(half,))


@pytest.fixture
def cloud(tmp_path: Path) -> Iterator[UploadCloud]:
    with UploadCloud(tmp_path / "cloud.sqlite", BaseMap({TILE: BASE}), MergeParameters()) as cloud:
        yield cloud


def test_flags_go_first_and_only_what_is_asked_for_follows(cloud: UploadCloud) -> None:
    base = cloud.map()
    found = upload(result_of(report_of(1, base), base), base, cloud)
    assert (found.changed, found.tiles, found.observed) == (4, 1, 8)
    assert found.classes == {"new": 2, "modified": 1, "deleted": 1}
    assert found.wanted == 3
    assert found.messages == 2
    assert found.parts["whole"] == 0
    assert sum(found.parts.values()) - found.parts["acks"] == found.bytes < found.wire_bytes
    assert found.bytes < 400 < found.float_bytes


def test_what_a_fleet_agrees_on_is_merged_and_no_longer_reported(cloud: UploadCloud) -> None:
    base = cloud.map()
    sizes = [upload(result_of(report_of(n, base), base), base, cloud).wanted for n in range(1, 9)]
    assert sizes[-1] == 0
    assert sizes == sorted(sizes, reverse=True)
    assert cloud.merge() == 1
    merged = cloud.map()
    assert merged.version(TILE) == 2
    assert merged.tiles[TILE].voxel_id.tolist() == [0, 2, 3, 4, 5, 10, 11]
    assert cloud.merge() == 0


def test_a_short_half_that_cannot_be_read_is_followed_by_the_whole_report(cloud: UploadCloud) -> None:
    base = cloud.map()
    good = result_of(report_of(1, base), base)
    other = BaseMap({TILE: grounds([0, 1, 7], 0.1)})
    strange = pack(report_of(1, other), {other.shas[TILE]: other.tiles[TILE]}, track()).encode()
    found = upload(replace(good, packed=(strange,)), base, cloud)
    assert found.parts["whole"] == len(good.reports[0])
    cloud.merge()


def test_a_report_that_is_refused_is_no_upload(cloud: UploadCloud) -> None:
    base = cloud.map()
    good = report_of(1, base)
    report = replace(good, tiles=(replace(good.tiles[0], pose_sigma_m=0.8),))
    with pytest.raises(ReproduceError, match="0 of 1 reports"):
        upload(result_of(report, base, packed=b""), base, cloud)
    with pytest.raises(ReproduceError, match="refused"):
        cloud.merge()
    assert base.shas == cloud.map().shas
