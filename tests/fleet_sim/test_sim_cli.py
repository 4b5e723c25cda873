import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from gnd.fleet_sim.cli import sim
from gnd.fleet_sim.errors import SimError
from gnd.fleet_sim.feature_files import read_feature_layers
from gnd.fleet_sim.feature_truth import base_features, feature_truth
from gnd.fleet_sim.prepare import agent_configs, prepare_fleet_run
from gnd.fleet_sim.street import StreetOptions, street
from gnd.fleet_sim.truth import Truth, read_truth
from gnd.fleet_sim.world import read_world
from gnd.gnd_map.errors import GndError
from gnd.schemas.drive_mcap import drive_counts, load_track, read_header


def run(*arguments: object) -> str:
    result = CliRunner().invoke(sim, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def test_a_world_is_written_and_inspected(tmp_path: Path) -> None:
    path = tmp_path / "w.json"
    assert "seed 4" in run("world", "write", path, "--seed", 4)
    assert read_world(path) == street(4)
    found = json.loads(run("world", "inspect", path, "--json"))
    assert (found["seed"], found["length_m"]) == (4, 200.0)
    assert found["edits"]["added"] > 10
    text = run("world", "inspect", path)
    assert "heading_deg" in text
    assert "building" in text


def test_a_long_world_at_another_place_is_written_and_inspected(tmp_path: Path) -> None:
    path = tmp_path / "w.json"
    assert "400 m" in run("world", "write", path, "--seed", 2, "--length", 400, "--site", "wangsimni")
    assert read_world(path) == street(2, StreetOptions(400.0, "wangsimni"))
    found = json.loads(run("world", "inspect", path, "--json"))
    assert found["districts"] == ["13033/03021/23031"]
    edits = sum(found["edits"].values()) - found["edits"]["kept"]
    assert edits == sum(sum(kinds.values()) for kinds in found["edits_by_kind"].values())
    assert edits == sum(sum(place.values()) for place in found["edits_by_place"].values())
    assert len(found["edits_by_place"]) == 8
    text = run("world", "inspect", path)
    assert "-200 … -150" in text
    assert "reshaped" in text


def test_a_world_at_coordinates_is_written(tmp_path: Path) -> None:
    path = tmp_path / "w.json"
    run("world", "write", path, "--length", 100, "--lat", 48.2, "--lon", 16.37)
    assert read_world(path) == street(1, StreetOptions(100.0, lat_deg=48.2, lon_deg=16.37))


@pytest.mark.parametrize(("sensor", "model"), [("rs32", "RS-LiDAR-32"), ("Scala", "Scala")])
def test_a_drive_with_any_sensor_and_traffic_is_written(sensor: str, model: str, tmp_path: Path) -> None:
    run("world", "write", tmp_path / "w.json", "--length", 100)
    options = ("--sensor", sensor, "--scans", 2, "--traffic", "urban", "--cars", 0.35)
    run("drive", tmp_path / "w.json", tmp_path / "d.mcap", *options)
    assert read_header(tmp_path / "d.mcap").sensor_model == model


def test_a_drive_is_written(tmp_path: Path) -> None:
    run("world", "write", tmp_path / "w.json")
    options = ("--sensor", "HDL-32E", "--state", "before", "--reverse", "--scans", 2, "--vehicle", "v-7", "--seed", 5)
    assert "MB" in run("drive", tmp_path / "w.json", tmp_path / "d.mcap", *options)
    header = read_header(tmp_path / "d.mcap")
    assert (header.vehicle, header.sensor_model) == ("v-7", "HDL-32E")
    assert "state before, drive seed 5" in header.source


@pytest.mark.parametrize(
    "arguments",
    [
        lambda folder: ["world", "inspect", folder / "none.json"],
        lambda folder: ["world", "write", folder / "no" / "w.json"],
        lambda folder: ["world", "write", folder / "w.json", "--seed", "-1"],
        lambda folder: ["world", "write", folder / "w.json", "--length", "1e9"],
        lambda folder: ["world", "write", folder / "w.json", "--length", "nan"],
        lambda folder: ["world", "write", folder / "w.json", "--lat", "48"],
        lambda folder: ["drive", folder / "none.json", folder / "d.mcap"],
        lambda folder: ["drive", folder / "none.json", folder / "d.mcap", "--sensor", "vlp128"],
    ],
)
def test_bad_input_is_an_error_of_ours_and_leaves_nothing(
    arguments: Callable[[Path], list[object]], tmp_path: Path
) -> None:
    with pytest.raises(GndError):
        run(*arguments(tmp_path))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_picture_of_a_world_is_drawn(truth_1: tuple[Truth, Path], tmp_path: Path) -> None:
    run("world", "write", tmp_path / "w.json")
    shutil.copy(truth_1[1], tmp_path / "truth.npz")
    output = run("world", "picture", tmp_path / "w.json", tmp_path / "w.png", "--truth", tmp_path / "truth.npz")
    assert "new" in output
    assert (tmp_path / "w.png").stat().st_size > 100_000


@pytest.mark.slow
def test_a_fleet_run_is_prepared(truth_1: tuple[Truth, Path], tmp_path: Path) -> None:
    shutil.copy(truth_1[1], tmp_path / "truth.npz")  # kept truths are used again
    fleet = prepare_fleet_run(1, 2, tmp_path, processes=2, scans=3)
    assert read_feature_layers(fleet.features_path) == base_features(feature_truth(street(1)))
    assert [drive_counts(drive).detections for drive in (*fleet.agent_drives, *fleet.base_drives)] == [5, 5, 0, 0]
    assert [read_header(path).vehicle for path in fleet.base_drives] == ["mapper-0", "mapper-1"]
    assert [read_header(path).sensor_model for path in fleet.agent_drives] == ["VLP-16", "HDL-32E"]
    assert read_world(fleet.world_path) == street(1)
    assert len(read_truth(fleet.truth_path)) == len(truth_1[0])
    starts = [load_track(path).motion.t_ns[0] for path in (*fleet.base_drives, *fleet.agent_drives)]
    assert starts == sorted(starts)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["drives", "features.json", "truth.npz", "world.json"]


def test_drives_of_one_fleet_are_stamped_a_headway_apart() -> None:
    for headway_s, step_s in ((4.0, 4.0), (0.0, 3600.0)):
        starts_ns = [config.start_ns for config in agent_configs(1, 5, headway_s)]
        assert np.diff(starts_ns).tolist() == [int(step_s * 1e9)] * 4


def test_a_fleet_run_in_a_place_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(SimError, match="cannot make the folder"):
        prepare_fleet_run(1, 1, tmp_path / "file")


def test_the_map_before_and_a_drive_with_a_camera_are_written(tmp_path: Path) -> None:
    run("world", "write", tmp_path / "w.json", "--seed", 1)
    output = run("world", "features", tmp_path / "w.json", tmp_path / "f.json")
    assert "signs: 28 normal, 6 deleted, 9 new" in output
    assert read_feature_layers(tmp_path / "f.json").keys() == {"signs"}
    run("drive", tmp_path / "w.json", tmp_path / "d.mcap", "--scans", 3, "--camera")
    assert drive_counts(tmp_path / "d.mcap").detections == 5
