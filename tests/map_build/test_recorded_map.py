"""Whole builds on simulated drives: passes that drift apart, a street that repeats itself, traffic, odd drives."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from drifting_drives import MapDrift, drift_drive, relative_errors

from gnd.deploy.map_cli import map_group
from gnd.deploy.map_page import write_map_page
from gnd.fleet_sim.drives import PERFECT, DriveConfig, DriveSimulation, simulate_drive
from gnd.fleet_sim.street import StreetOptions, street
from gnd.fleet_sim.traffic import Traffic
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.motion import Trajectory
from gnd.schemas.drive import DriveHeader, ReferencePose, Scan
from gnd.schemas.drive_mcap import DriveWriter, read_drive, read_header
from gnd.tile_store.build import BuildError, drive_sources
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.map_build.build import BuiltMap, build_recorded_map, no_progress
from gnd.vehicle_agent.map_build.quality import Quality, measure
from gnd.vehicle_agent.map_build.refine_poses import refine_poses
from gnd.vehicle_agent.map_build.result import summary
from gnd.vehicle_agent.map_build.survey import look_over

SEED = 103
PASSES = ((1, 11), (-1, 12))


@pytest.fixture(scope="module")
def passes(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], list[Trajectory]]:
    """A street driven up and down, each time with odometry for a reference; the second begins beside the truth."""
    folder, world = tmp_path_factory.mktemp("passes"), street(SEED, StreetOptions(length_m=100.0))
    paths, truths = [], []
    for number, (direction, seed) in enumerate(PASSES):
        config = DriveConfig("car", "VLP-16", "before", seed=seed, direction=direction, cruise_mps=12.0)
        paths.append(folder / f"{number}.mcap")
        truths.append(drift_drive(world, config, paths[-1], MapDrift(start_m=0.8 * number, start_deg=0.5 * number)))
    return paths, truths


def gnd_map(*arguments: object) -> Any:
    result = CliRunner().invoke(map_group, [*map(str, arguments), "--json"], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


@pytest.mark.slow
def test_passes_that_drifted_apart_become_one_map(passes: tuple[list[Path], list[Trajectory]], tmp_path: Path) -> None:
    paths, truths = passes
    with SqliteStore(tmp_path / "apart.db") as store:
        apart = summary(*measured(build_recorded_map(paths, store, refine="never")))
    with SqliteStore(tmp_path / "closed.db") as store:
        built, quality = measured(build_recorded_map(paths, store))
    closed, page = summary(built, quality), tmp_path / "page.html"
    assert closed["poses"]["refined"]
    assert closed["poses"]["before"]["horizontal_m"] > 0.5
    assert closed["poses"]["after"]["horizontal_m"] < 0.03
    for kind in ("doubled_walls", "doubled_road"):
        assert closed["quality"][kind]["per_thousand"] < 20.0
    assert max(apart["quality"][kind]["per_thousand"] for kind in ("doubled_walls", "doubled_road")) > 40.0
    assert any("are double" in warning for warning in apart["warnings"])
    assert closed["warnings"] == []
    error = relative_errors([source.poses for source in built.sources], truths)
    assert np.quantile(error, 0.95) < 0.35  # what is left is the drift that both have in common
    write_map_page(page, "closed.db", built, quality)
    text = page.read_text()
    assert "Nothing is out of bounds" in text
    assert text.count("data:image/png;base64,") == 3
    assert "src=" not in text.replace('src="data:', "")


def measured(built: BuiltMap) -> tuple[BuiltMap, Quality]:
    return built, measure(built)


@pytest.mark.slow
def test_poses_that_agree_are_left_alone(tmp_path: Path) -> None:
    world, paths = street(SEED, StreetOptions(length_m=100.0)), []
    for direction, seed in PASSES:
        config = DriveConfig("car", "VLP-16", "before", seed=seed, direction=direction, cruise_mps=12.0, errors=PERFECT)
        paths.append(simulate_drive(world, config, tmp_path / f"{seed}.mcap"))
    told = gnd_map("build", *paths, "-o", tmp_path / "map.db")
    assert not told["poses"]["refined"]
    assert "passes agree" in told["poses"]["reason"]
    assert told["poses"]["before"]["horizontal_m"] < 0.03
    assert told["warnings"] == []
    assert abs(told["by_drive"][0]["mount"]["road_m"]) < 0.03


def colonnade(path: Path, shift_m: float, seed: int, mount_m: float = 1.9) -> Path:
    """A drive of 90 m past posts 6 m apart before even walls; its reference is `shift_m` off along the street."""
    rng, anchor = np.random.default_rng(seed), LocalFrame(np.radians(37.5597), np.radians(127.0365), 30.0)
    mount = np.eye(4)
    mount[2, 3] = mount_m
    with DriveWriter(path, DriveHeader(f"posts-{seed}", "car", "test", anchor, mount, "made by a test")) as writer:
        for k in range(90):
            t_ns, T = 1_700_000_000_000_000_000 + k * 100_000_000, np.eye(4)
            T[0, 3] = k + shift_m
            writer.reference(ReferencePose(t_ns, T))
            x = k + rng.uniform(-45, 45, (9000, 1))
            road = np.c_[x[:4000], rng.uniform(-7.9, 7.9, 4000), np.zeros(4000)]
            wall = np.c_[x[4000:7000], rng.choice([-8.0, 8.0], 3000), rng.uniform(0, 6, 3000)]
            post = np.c_[
                6 * np.round(x[7000:] / 6), rng.choice([-6.0, 6.0], 2000), rng.uniform(0, 4, 2000)
            ] + rng.uniform([-0.2, -0.2, 0], [0.2, 0.2, 0], (2000, 3))
            points = np.concatenate([road, wall, post]) + 0.01 * rng.standard_normal((9000, 3)) - [k, 0.0, 1.9]
            writer.scan(Scan(t_ns, points.astype(np.float32), np.zeros(len(points), np.uint32)))
    return path


@pytest.mark.slow
def test_a_street_that_repeats_itself_closes_no_wrong_loop(tmp_path: Path) -> None:
    """Two passes, the second 1.2 m off along; every 6 m looks the same, and drives may be off by more than that."""
    paths = [colonnade(tmp_path / "a.mcap", 0.0, 1), colonnade(tmp_path / "b.mcap", 1.2, 2)]
    sources = drive_sources(paths)
    surveys = [look_over(source, no_progress) for source in sources]
    found, report = refine_poses(sources, surveys, "auto", no_progress)
    assert report.candidates is not None
    assert report.candidates.ambiguous > 0.5 * report.candidates.tried
    moved = [
        float(np.abs(new.poses.T_dst_vehicle[:, :3, 3] - old.poses.T_dst_vehicle[:, :3, 3]).max())
        for new, old in zip(found, sources, strict=True)
    ]
    assert max(moved) < 1.5, report  # never by a period


@pytest.mark.slow
def test_traffic_is_left_out_unless_it_is_asked_for(tmp_path: Path) -> None:
    world = street(SEED)
    config = DriveConfig("car", "HDL-32E", "before", seed=3, traffic=Traffic.urban(), scans=60, errors=PERFECT)
    path = tmp_path / "traffic.mcap"
    simulation, movers, points = DriveSimulation(world, config), 0, 0
    with DriveWriter(path, simulation.header()) as writer:
        marks: list[np.ndarray] = []
        for item in simulation.items(on_labels=lambda _, moves: marks.append(moves)):
            writer.add(item)
        movers = sum(int(mark.sum()) for mark in marks)
    kept = gnd_map("build", path, "-o", tmp_path / "kept.db", "--keep-movers")
    told = gnd_map("build", path, "-o", tmp_path / "map.db")
    points = kept["points"]
    assert kept["points_of_movers"] == 0
    assert told["points"] + told["points_of_movers"] + told["points_of_bodywork"] == points
    assert 0.8 * movers < told["points_of_movers"] < 1.1 * movers + 0.003 * points
    assert told["points_of_bodywork"] < 0.0005 * points


def test_scans_without_a_pose_have_their_reason(tmp_path: Path) -> None:
    path, shorter = colonnade(tmp_path / "a.mcap", 0.0, 1), tmp_path / "b.mcap"
    items = list(read_drive(path))
    poses = [item for item in items if isinstance(item, ReferencePose)]
    with DriveWriter(shorter, read_header(path)) as writer:
        for item in items:
            if not isinstance(item, ReferencePose) or poses[10].t_ns <= item.t_ns <= poses[80].t_ns:
                writer.add(item)
    with SqliteStore(tmp_path / "map.db") as store:
        built = build_recorded_map([shorter], store)
    missing = built.counts[0].without_pose
    assert missing["before the first pose"] in (8, 9, 10)
    assert missing["after the last pose"] in (7, 8, 9)
    assert built.counts[0].scans + missing.total() == 90
    warning = next(w for w in measure(built).warnings if "no pose" in w)
    assert f"{missing['before the first pose']} before the first pose" in warning


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda t: t + 3_600_000_000_000, r"none of 90 scans has a pose: 90 before the first pose"),
        (lambda t: t - 3_600_000_000_000, r"none of 90 scans has a pose: 90 after the last pose"),
    ],
)
def test_two_clocks_are_refused(tmp_path: Path, change: Callable[[int], int], says: str) -> None:
    path, other = colonnade(tmp_path / "a.mcap", 0.0, 1), tmp_path / "b.mcap"
    with DriveWriter(other, read_header(path)) as writer:
        for item in sorted(read_drive(path), key=lambda one: isinstance(one, Scan)):
            if isinstance(item, ReferencePose):
                writer.add(ReferencePose(change(item.t_ns), item.T_map_vehicle))
            else:
                writer.add(item)
    with SqliteStore(tmp_path / "map.db") as store, pytest.raises(BuildError, match=says):
        build_recorded_map([other], store)


def test_a_page_that_cannot_be_written_is_refused_before_the_work(tmp_path: Path) -> None:
    for report in (tmp_path, tmp_path / "no" / "page.html"):
        with pytest.raises(GndError, match="cannot write the page"):
            gnd_map("build", tmp_path / "absent.mcap", "-o", tmp_path / "map.db", "--report", report)
    assert list(tmp_path.iterdir()) == []


def test_the_command_writes_a_page_and_says_that_the_mount_is_wrong(tmp_path: Path) -> None:
    """A header that has the LiDAR on the road, as imports without a mount do."""
    path, page = colonnade(tmp_path / "a.mcap", 0.0, 1, mount_m=0.0), tmp_path / "page.html"
    arguments = ["build", str(path), "-o", str(tmp_path / "map.db"), "--report", str(page)]
    result = CliRunner().invoke(map_group, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert f"page written: {page}" in result.stdout
    said = " ".join(result.stdout.split())
    assert "the road lies 1.90 m below where the wheels should stand" in said
    assert "the header has the LiDAR 0.00 m over the road, the scans 1.90 m" in said
    assert "the road lies 1.90 m below" in page.read_text()
    right = gnd_map("build", colonnade(tmp_path / "b.mcap", 0.0, 1), "-o", tmp_path / "right.db")
    assert not [warning for warning in right["warnings"] if "wheels" in warning]
    assert right["by_drive"][0]["mount"]["seen_m"] == pytest.approx(1.9, abs=0.03)
