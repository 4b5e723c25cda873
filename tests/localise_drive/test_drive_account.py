"""Health timeline, errors, pictures and tables of a drive made by hand."""

import json
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_from_R_t, exp_so3
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import DriveHeader, GnssTrack
from gnd.vehicle_agent.errors import LocaliseError
from gnd.vehicle_agent.localise.estimates import Health, PoseEstimate, error_series, localisation_error
from gnd.vehicle_agent.localise_drive.account import health_json, print_account, summary
from gnd.vehicle_agent.localise_drive.accuracy import error_summary
from gnd.vehicle_agent.localise_drive.geo import geojson_text
from gnd.vehicle_agent.localise_drive.map_picture import PictureView, draw_pictures, nice_m
from gnd.vehicle_agent.localise_drive.map_raster import GROUND, OTHER, WALL, MapRaster, disc, kinds_of
from gnd.vehicle_agent.localise_drive.outputs import position_cov_m2
from gnd.vehicle_agent.localise_drive.run import DriveTotals, LocalisedDrive, Moment
from gnd.vehicle_agent.localise_drive.stretches import stretches_of

T0_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000
TILE = TileId(497353963154)
FRAME = LocalFrame.of_tile(TILE)
HEALTH: list[Health] = ["lost"] * 3 + ["good"] * 10 + ["degraded"] * 2 + ["lost"] * 20 + ["good"] * 5


def moment(k: int, health: Health) -> Moment:
    return Moment(T0_NS + k * STEP_NS, 1.0 * k, health, "none" if health == "good" else "poor_place")


def pose(k: int, health: Health, *, off_m: tuple[float, float] = (0.0, 0.0), turn_deg: float = 0.0) -> PoseEstimate:
    """Driving north at 10 m/s, so that forward is north and left is west."""
    along, left = off_m
    T = T_from_R_t(exp_so3([0, 0, np.pi / 2 + np.radians(turn_deg)]), [-left, k + along, 30.0])
    return PoseEstimate(T0_NS + k * STEP_NS, T, 0.01, 0.001, 0.9, health)


def drive(healths: list[Health], **values: Any) -> LocalisedDrive:
    """Poses wherever the health is not lost; a reference and GNSS fixes everywhere."""
    poses = tuple(pose(k, h, off_m=(0.02, -0.01), turn_deg=0.1) for k, h in enumerate(healths) if h != "lost")
    true = [pose(k, "good") for k in range(len(healths))]
    t_ns = np.array([p.t_ns for p in true], np.int64)
    fixes = FRAME.geodetic_from_enu(np.stack([p.T_map_vehicle[:3, 3] for p in true]))
    known: dict[str, Any] = {
        "header": DriveHeader("by-hand", "car-1", "VLP-16", FRAME, np.eye(4)),
        "refined": poses,
        "online": poses,
        "moments": tuple(moment(k, h) for k, h in enumerate(healths)),
        "reference": Trajectory(t_ns, np.stack([p.T_map_vehicle for p in true])),
        "gnss": GnssTrack(t_ns, *fixes, np.full(len(true), 2.5)),
        "used": {TILE: 1},
        "absent": frozenset(),
        "counts": DriveTotals(len(healths), {}, healths.count("lost"), 2, 1.001, 0.002, 1.0, finished=True),
    }
    return LocalisedDrive(**(known | values))


class OneTile:
    """A corridor of ground and a wall along it."""

    def tile(self, tile_id: TileId) -> Tile | None:
        accumulator = VoxelAccumulator(GridFrame.around(FRAME, [TILE]))
        rng = np.random.default_rng(0)
        x, y, z = rng.uniform([-5, -15, 0], [5, 15, 4], (60_000, 3)).T
        accumulator.add(np.stack([x, y, np.full_like(x, 30.5)], axis=1))
        accumulator.add(np.stack([np.full_like(x, 5.2), y, 30.5 + z], axis=1))
        return Tile(TILE, 1, accumulator.finish()[TILE]) if tile_id == TILE else None


def test_stretches_follow_one_another_and_hold_every_scan() -> None:
    found = stretches_of([moment(k, h) for k, h in enumerate(HEALTH)])
    assert [(one.health, one.scans) for one in found] == [
        ("lost", 3), ("good", 10), ("degraded", 2), ("lost", 20), ("good", 5),
    ]  # fmt: skip
    assert [(round(one.from_s, 6), round(one.to_s, 6)) for one in found] == [
        (0.0, 0.3), (0.3, 1.3), (1.3, 1.5), (1.5, 3.5), (3.5, 3.9),
    ]  # fmt: skip
    assert [(one.from_m, one.to_m) for one in found] == [(0, 3), (3, 13), (13, 15), (15, 35), (35, 39)]
    assert stretches_of([]) == []


def test_another_cause_is_another_stretch() -> None:
    causes = [Moment(T0_NS + k, 0.0, "degraded", cause) for k, cause in enumerate(["gap", "gap", "stale_map"])]
    assert [(one.cause, one.scans) for one in stretches_of(causes)] == [("gap", 2), ("stale_map", 1)]


def test_errors_have_signs_and_agree_with_localisation_error() -> None:
    made = drive(HEALTH)
    series = error_series(made.refined, made.reference)
    assert series.longitudinal == pytest.approx(0.02)
    assert series.lateral == pytest.approx(-0.01)
    assert series.heading == pytest.approx(0.1)
    found, plain = error_summary(series), localisation_error(made.refined, made.reference)
    assert found is not None
    assert found["longitudinal_m"] == {"p95": 0.02, "max": 0.02, "within_limits": True}
    assert (found["n"], found["heading_deg"]["max"]) == (plain.n, pytest.approx(plain.heading_max_deg, abs=1e-5))


@pytest.mark.parametrize(("off_m", "kept"), [(0.14, True), (0.16, False)])
def test_a_limit_is_kept_or_not(off_m: float, kept: bool) -> None:
    poses = [pose(k, "good", off_m=(0.0, off_m)) for k in range(10)]
    found = error_summary(error_series(poses, drive(HEALTH).reference))
    assert found is not None
    assert found["lateral_m"]["within_limits"] is kept


def test_one_error_beyond_the_larger_limit_is_enough() -> None:
    poses = [pose(k, "good", off_m=(0.45 if k == 3 else 0.0, 0.0)) for k in range(40)]
    found = error_summary(error_series(poses, drive(HEALTH).reference))
    assert found is not None
    assert found["longitudinal_m"] == {"p95": 0.0, "max": 0.45, "within_limits": False}


def test_poses_called_good_are_judged_apart() -> None:
    """The degraded ones are off by metres and say that they are not sure."""
    poses = tuple(
        pose(k, h, off_m=(3.0 if h == "degraded" else 0.01, 0.0)) for k, h in enumerate(HEALTH) if h != "lost"
    )
    errors = summary(drive(HEALTH, refined=poses, online=poses))["errors"]
    assert errors["refined"]["longitudinal_m"] == {"p95": 3.0, "max": 3.0, "within_limits": False}
    assert errors["refined_good"]["longitudinal_m"] == {"p95": 0.01, "max": 0.01, "within_limits": True}
    assert (errors["online"]["n"], errors["online_good"]["n"]) == (17, 15)


def test_covariances_are_turned_into_the_map() -> None:
    """Driving north, what is uncertain forward is uncertain along y."""
    known = [replace(pose(k, "good"), covariance=np.diag([0, 0, 0, 0.04, 0.01, 0.09])) for k in range(2)]
    found = position_cov_m2(known)
    assert found is not None
    assert found == pytest.approx(np.stack([np.diag([0.01, 0.04, 0.09])] * 2))
    assert position_cov_m2([*known, pose(2, "good")]) is None
    assert position_cov_m2([]) is None


def test_the_summary_says_when_the_first_pose_came() -> None:
    values = summary(drive(HEALTH))
    assert values["initialisation_s"] == 0.3
    assert values["localised_share"] == round(17 / 40, 4)
    assert values["health"]["lost"] == {"s": 2.3, "m": 23.0, "scans": 23}
    assert json.loads(json.dumps(values)) == values


def test_a_drive_that_never_finds_its_pose_is_told_and_drawn(tmp_path: Path) -> None:
    made = drive(["lost"] * 8, used={})
    values, text = summary(made), StringIO()
    assert (values["initialisation_s"], values["scans_localised"], values["sigma"]) == (None, 0, None)
    print_account(Console(file=text, width=120), values, stretches_of(made.moments))
    assert "never" in text.getvalue()
    assert {path.name for path in draw_pictures(made, OneTile(), tmp_path)} == {"map.png", "quality.png"}
    [feature] = json.loads(geojson_text(made))["features"]
    assert feature["geometry"]["type"] == "Point"


def test_without_a_single_scan_there_is_still_an_account(tmp_path: Path) -> None:
    made = drive(
        ["good"], moments=(), refined=(), online=(), counts=DriveTotals(0, {}, 0, 0, 1.0, 0.0, 0.1, finished=False)
    )
    assert summary(made)["localised_share"] == 0.0
    assert health_json(made)["stretches"] == []
    assert len(draw_pictures(made, OneTile(), tmp_path)) == 2


def test_a_long_timeline_is_cut_when_printed() -> None:
    flicker: list[Health] = ["good", "degraded"] * 25
    text = StringIO()
    print_account(Console(file=text, width=120), summary(drive(flicker)), stretches_of(drive(flicker).moments))
    assert "... and 20 more stretches in health.json" in text.getvalue()


def test_pictures_of_a_drive_with_a_gap_are_drawn(tmp_path: Path) -> None:
    names = {path.name: path.stat().st_size for path in draw_pictures(drive(HEALTH), OneTile(), tmp_path)}
    assert names.keys() == {"map.png", "quality.png", "errors.png"}
    assert min(names.values()) > 10_000
    with pytest.raises(LocaliseError, match="cannot write the picture"):
        draw_pictures(drive(HEALTH), OneTile(), tmp_path / "none")


def test_lines_meet_and_a_lost_stretch_is_a_point() -> None:
    features = json.loads(geojson_text(drive(HEALTH)))["features"]
    assert [f["properties"]["health"] for f in features] == ["lost", "good", "degraded", "lost", "good"]
    kinds = [f["geometry"]["type"] for f in features]
    assert kinds == ["Point", "LineString", "LineString", "Point", "LineString"]
    assert features[1]["geometry"]["coordinates"][-1] == features[2]["geometry"]["coordinates"][0]


def test_the_map_from_above_has_ground_and_wall_where_they_are() -> None:
    """East is right, north is up: the wall stands at x = 5.2 m."""
    raster = MapRaster(FRAME, np.eye(2), -10.0, -10.0, 0.1, (200, 200))
    tile = OneTile().tile(TILE)
    assert tile is not None
    raster.add(tile)
    image = raster.image()
    assert raster.gaussians == len(tile.gaussians)
    assert image[100, 152].mean() < image[100, 100].mean() < image[100, 190].mean() == 1.0


def test_kinds_of_surfaces() -> None:
    ground, wall, ball = np.diag([0.1, 0.1, 0.001]), np.diag([0.001, 0.1, 0.1]), np.diag([0.05, 0.06, 0.07])
    assert kinds_of(np.stack([ground, wall, ball])).tolist() == [GROUND, WALL, OTHER]


def test_a_disc_is_even() -> None:
    """The inner disc of half the area holds half of the points."""
    radius = np.linalg.norm(disc(1000), axis=1)
    assert radius.max() <= 1.0
    assert np.mean(radius <= np.sqrt(0.5)) == pytest.approx(0.5, abs=0.01)


def test_a_view_lays_the_drive_to_the_right_and_keeps_all_of_it() -> None:
    north = np.stack([np.zeros(50), np.linspace(0, 400, 50)], axis=1)
    view = PictureView.around(north)
    at = north @ view.R_view_map.T
    assert np.ptp(at[:, 0]) == pytest.approx(400)
    assert (at >= view.low_m).all()
    assert (at <= view.high_m).all()
    assert np.linalg.det(view.R_view_map) == pytest.approx(1.0)  # not mirrored


@pytest.mark.parametrize(("length_m", "nice"), [(0.0, 10), (22.0, 20), (33.0, 50), (8_000.0, 10_000), (1e9, 100_000)])
def test_nice_lengths(length_m: float, nice: int) -> None:
    assert nice_m(length_m) == nice
