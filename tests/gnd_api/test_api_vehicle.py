"""Recorded drives and a fed vehicle: poses against the drive's reference, reports up to a real merger."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from api_testing import EAST, HERE, Cloud, Program, sign_tile
from changed_street import SCANS

import gnd
from gnd.fleet_bus.errors import RequestFailed
from gnd.gnd_map.content import AnyTile
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.tile_id import TileId
from gnd.live_vehicle import FeatureTilesOfMap, Fetch, TilesOfMap
from gnd.schemas.changes import ChangeReport
from gnd.schemas.drive import GnssFix, MotionSample, ReferencePose, Scan
from gnd.schemas.keys import batch_key
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.link.feature_tiles_on_the_bus import STEP_M
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.place import Place
from gnd.vehicle_agent.tiles_at_hand import TilesAtHand

Files = tuple[Path, Path]


@pytest.fixture(scope="module")
def opened(street_files: Files) -> Iterator[gnd.Map]:
    with gnd.Map(street_files[1]) as opened:
        yield opened


@pytest.fixture(scope="module")
def driven(street_files: Files, opened: gnd.Map) -> dict[str, Any]:
    """The whole drive through a vehicle."""
    drive = gnd.open_drive(street_files[0])
    with gnd.Vehicle.of_drive(opened, drive.header) as vehicle:
        outputs = [vehicle.push(item) for item in drive]
        outputs.append(vehicle.finish())
        return {
            "frame": vehicle.frame,
            "poses": [pose for output in outputs for pose in output.poses],
            "reports": [report for output in outputs for report in output.reports],
        }


def errors_m(poses: Trajectory, frame: gnd.LocalFrame, drive: gnd.RecordedDrive) -> np.ndarray:
    """(N,) horizontal distances from the drive's reference."""
    reference = [item for item in drive if isinstance(item, ReferencePose)]
    truth = Trajectory(np.array([r.t_ns for r in reference]), np.stack([r.T_map_vehicle for r in reference]))
    at = frame.T_self_other(drive.header.anchor) @ truth.at(poses.t_ns)
    return np.hypot(*(poses.T_dst_vehicle[:, :2, 3] - at[:, :2, 3]).T)


def test_a_drive_is_read_as_often_as_one_likes(street_files: Files) -> None:
    drive = gnd.open_drive(str(street_files[0]))
    assert (drive.header.vehicle, drive.counts.scans) == ("car", SCANS)
    for _ in range(2):
        assert sum(isinstance(item, Scan) for item in drive) == SCANS
    with pytest.raises(gnd.GndError, match="nowhere"):
        gnd.open_drive("nowhere.mcap")


@pytest.mark.slow
def test_localise_gives_poses_on_the_map(street_files: Files, opened: gnd.Map) -> None:
    drive, seen = gnd.open_drive(street_files[0]), list[tuple[int, int]]()
    found = gnd.localise(drive, opened, progress=lambda done, total: seen.append((done, total)))
    assert seen[-1] == (SCANS, SCANS)
    poses = gnd.trajectory_of(found.refined)
    assert poses.T_dst_vehicle.shape == (len(found.refined), 4, 4)
    assert len(poses) > SCANS / 2
    assert errors_m(poses, drive.header.anchor, drive).max() < 0.3
    with pytest.raises(gnd.GndError, match="no tiles in layer ndt_other"):
        gnd.localise(drive, opened, layer="ndt_other")
    with pytest.raises(gnd.GndError, match="existed at 1970"):
        gnd.localise(street_files[0], street_files[1], at="1970-01-02T00:00:00Z")


@pytest.mark.slow
def test_a_fed_vehicle_localises_as_the_command_does(
    street_files: Files, driven: dict[str, Any], opened: gnd.Map
) -> None:
    drive = gnd.open_drive(street_files[0])
    poses = gnd.trajectory_of(tuple(driven["poses"]))
    assert errors_m(poses, driven["frame"], drive).max() < 0.3
    by_command = gnd.trajectory_of(gnd.localise(drive, opened).refined)
    T_frame_anchor = driven["frame"].T_self_other(drive.header.anchor)
    assert np.array_equal(poses.t_ns, by_command.t_ns)
    assert np.allclose(poses.T_dst_vehicle, T_frame_anchor @ by_command.T_dst_vehicle, atol=1e-6)


def test_it_reports_what_has_changed(driven: dict[str, Any]) -> None:
    reports = [ChangeReport.decode(report.body) for report in driven["reports"]]
    assert {report.vehicle for report in reports} == {"car"}
    assert sum(len(tile.changed) for report in reports for tile in report.tiles) > 10


def test_measurements_as_numbers_and_arrays(street_files: Files, opened: gnd.Map, driven: dict[str, Any]) -> None:
    drive, poses = gnd.open_drive(street_files[0]), list[Any]()
    header = drive.header
    with gnd.Vehicle(
        street_files[1],
        header.T_vehicle_lidar.tolist(),
        name="by-hand",
        sensor_model=header.sensor_model,
        deskew=header.deskew,
        sweep_ns=header.sweep_ns,
        reports=False,
    ) as vehicle:
        for item in drive:
            if isinstance(item, Scan):
                poses += vehicle.push_scan(item.t_ns, item.points_m.astype(np.float64), item.t_offset_ns).poses
            elif isinstance(item, MotionSample):
                poses += vehicle.push_motion(item.t_ns, item.speed_mps, item.yaw_rate_radps).poses
            elif isinstance(item, GnssFix):
                lat_deg, lon_deg = np.degrees([item.lat_rad, item.lon_rad])
                poses += vehicle.push_gnss(item.t_ns, lat_deg, lon_deg, item.height_m, item.sigma_m).poses
        last = vehicle.finish()
    assert last.reports == ()
    found = gnd.trajectory_of((*poses, *last.poses))
    other = gnd.trajectory_of(tuple(driven["poses"]))
    assert np.array_equal(found.t_ns, other.t_ns)
    assert np.allclose(found.T_dst_vehicle, other.T_dst_vehicle, atol=1e-3)  # degrees round otherwise than radians


def test_what_comes_before_the_first_position_waits_for_it(street_files: Files, opened: gnd.Map) -> None:
    with gnd.Vehicle(opened, np.eye(4), reports=False) as vehicle:
        for second in range(100):
            output = vehicle.push_motion(second * 1_000_000_000, 1.0, 0.0)
            assert (output.online, output.health, output.cause) == (None, "lost", "no_position")
        with pytest.raises(gnd.NoPosition, match="11 measurements wait"):
            vehicle.finish()
        with pytest.raises(gnd.NoPosition):
            _ = vehicle.frame
        fix = next(item for item in gnd.open_drive(street_files[0]) if isinstance(item, GnssFix))
        vehicle.push(replace(fix, t_ns=100_000_000_000))
        assert vehicle.pipeline.place.odometer_m == pytest.approx(10.0, abs=1.1)


def test_what_is_no_mount_is_refused(opened: gnd.Map) -> None:
    with pytest.raises(gnd.GndError, match="T_vehicle_lidar"):
        gnd.Vehicle(opened, np.zeros((4, 4)))
    with pytest.raises(gnd.GndError, match="no such store"):
        gnd.Vehicle("nothing.sqlite", np.eye(4))


def test_the_tiles_of_a_district_are_one_question_and_features_come_too(
    cloud: Cloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    cloud.store.put_tiles([sign_tile(EAST, 8)], layer="signs")
    lat_rad, lon_rad = HERE.centre_rad
    frame = gnd.LocalFrame.of_tile(HERE)
    with gnd.connect(cloud.endpoint) as client:
        asked, request = list[str](), client.bus.request

        def counted(key: str, *args: Any, **how: Any) -> bytes:
            asked.append(key)
            return request(key, *args, **how)

        monkeypatch.setattr(client.bus, "request", counted)
        local_map = LocalMap(GridFrame.around(frame, [HERE]))
        place = Place(frame, GnssFix(0, lat_rad, lon_rad, 30.0, 1.0))
        fetch: Fetch = lambda layer, tiles: client.fetch(tiles, layer=layer)  # noqa: E731
        TilesAtHand(TilesOfMap(fetch, "ndt"), local_map, lambda _tile: False).follow(place)
        held = {tile_id for tile_id in local_map.tiles if (tile := local_map.tile(tile_id)) and tile.version}
        assert held == {HERE, EAST}
        districts = {tile_id.district for tile_id in local_map.tiles}
        assert sorted(asked) == sorted(batch_key("ndt", district) for district in districts)
        asked.clear()
        features = FeatureTilesOfMap(fetch, ["signs"])
        assert [(layer, tile.tile_id) for layer, tile in features.follow(place)] == [("signs", HERE), ("signs", EAST)]
        assert len(asked) == len(set(asked))
        assert list(features.follow(place)) == [], "no way, no question"


def test_features_that_a_lost_link_did_not_bring_are_asked_for_again() -> None:
    lat_rad, lon_rad = HERE.centre_rad
    place, asked = Place(gnd.LocalFrame.of_tile(HERE), GnssFix(0, lat_rad, lon_rad, 30.0, 1.0)), list[str]()

    def once_without_answer(layer: str, tiles: Sequence[TileId]) -> Iterator[AnyTile]:
        asked.append(layer)
        if len(asked) == 1:
            raise RequestFailed("gnd/v1/tiles", 1, "no answer")
        return iter([sign_tile(HERE, 1)] if HERE in tiles else [])

    features = FeatureTilesOfMap(once_without_answer, ["signs"])
    with pytest.raises(RequestFailed):
        list(features.follow(place))
    place.odometer_m += STEP_M
    assert [tile.tile_id for _, tile in features.follow(place)] == [HERE]
    place.odometer_m += STEP_M
    assert list(features.follow(place)) == [], "each tile once"


@pytest.mark.slow
def test_tiles_come_from_the_bus_and_reports_go_there(
    cloud: Cloud, street_files: Files, driven: dict[str, Any], start: Callable[..., Program]
) -> None:
    with SqliteStore(street_files[1], create=False) as street:
        cloud.store.put_tiles([street.get("ndt", head.tile).decode() for head in street.heads()])  # type: ignore[union-attr]
    merger = ("-m", "gnd.deploy.cli", "merger", "--store", str(cloud.store.path), "--connect", cloud.endpoint)
    start(*merger, "--id", "m0")
    drive, reports = gnd.open_drive(street_files[0]), list[Any]()
    with gnd.connect(cloud.endpoint, timeout_s=60.0) as client:
        vehicle = gnd.Vehicle.of_drive(client, drive.header)
        for item in drive:
            reports += vehicle.push(item).reports
        reports += vehicle.finish().reports
        assert [report.report_id for report in reports] == [report.report_id for report in driven["reports"]]
        assert {client.upload(report) for report in reports} <= {"stored", "duplicate"}
        assert {client.upload(report) for report in reports} == {"duplicate"}
        with pytest.raises(gnd.ReportRefused, match="quarantined"):
            client.upload(replace(reports[0], body=reports[0].body[:-7]))
