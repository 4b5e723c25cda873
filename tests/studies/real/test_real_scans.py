"""`gnd reproduce real` on a small simulated recording: what is truth there, what is counted, what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from gnd.fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.shapes import Block
from gnd.fleet_sim.street import street
from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.errors import GndError
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.importer import no_progress, open_recording
from studies.frame.errors import RealDataError
from studies.real.rounds import KINDS, CellSurroundings, Painter, changed_by_shadow, choose_places, truth_of
from studies.real.scene import Cells, RecordedScans, RecordedScene, keys_of, load, place
from studies.real.study import RealOptions, changed, real, reproduce_real


@pytest.fixture(scope="session")
def street_drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixteen scans of 32 layers along an empty street, with reference poses."""
    path = tmp_path_factory.mktemp("real") / "street.mcap"
    return simulate_drive(
        street(1), DriveConfig("car", "HDL-32E", "before", errors=PERFECT, car_share=0.0, scans=16), path
    )


@pytest.fixture(scope="session")
def recorded(street_drive: Path) -> RecordedScans:
    return load(open_recording("auto", street_drive), 12, no_progress)


@pytest.fixture(scope="session")
def scene(recorded: RecordedScans) -> RecordedScene:
    return place(recorded, 1)


def test_keys_name_every_voxel_once(scene):
    rng = np.random.default_rng(0)
    g = rng.integers(-500, 500, (5000, 3)) + np.floor(scene.grid_frame.grid_of(np.zeros((1, 3)))).astype(np.int64)
    assert len(np.unique(keys_of(scene.grid_frame, g))) == len(np.unique(g, axis=0))


def test_cells_of_an_accumulator(scene):
    """Three points in two sub-cells of one voxel, one in the next voxel but one."""
    g = np.floor(scene.grid_frame.grid_of(np.zeros((1, 3)))).astype(np.int64)
    centre = scene.grid_frame.centre_map_m(g)[0]
    accumulator = VoxelAccumulator(scene.grid_frame)
    accumulator.add(centre + np.array([[0.05, 0.05, 0.05], [0.06, 0.05, 0.05], [0.25, 0.05, 0.05], [2.0, 0.0, 0.0]]))
    cells = Cells.of(accumulator)
    keys = keys_of(scene.grid_frame, g + np.array([[0, 0, 0], [1, 0, 0]]))
    assert cells.count_at(keys).tolist() == [3, 0]
    assert cells.cells_at(keys).tolist() == [2, 0]
    assert len(cells.dense(2)) == 1
    assert len(cells.keys) == 2


def test_a_recording_lies_on_the_grid_in_seeded_ways(recorded):
    poses = [place(recorded, number).poses.T_dst_vehicle for number in (0, 1, 1, 2)]
    np.testing.assert_array_equal(poses[0], recorded.track.T_dst_vehicle)
    np.testing.assert_array_equal(poses[1], poses[2])
    assert np.abs(poses[1] - poses[3]).max() > 0.1


def test_objects_stand_on_free_ground_beside_the_track(scene):
    around = CellSurroundings.of(scene)
    placed = choose_places(scene, around, 8, np.random.default_rng(0))
    assert [one.kind for one in placed] == [
        one.kind for one in choose_places(scene, around, 8, np.random.default_rng(0))
    ]
    assert {one.kind for one in placed} == set(KINDS)
    for one in placed:
        xy = np.array([one.shape.x_m, one.shape.y_m])
        assert np.linalg.norm(scene.positions_m[:, :2] - xy, axis=1).min() > one.radius_m + 1.0
        inside = np.abs(around.points_m[:, :2] - xy).max(axis=1) < 0.3
        assert not (inside & (around.points_m[:, 2] > one.shape.bottom_m + 0.6)).any()


def box_before(scene: RecordedScene) -> Block:
    """A box 6 m to the left of the middle of the track, from the ground up."""
    T = scene.poses.at(scene.scans[6].t_ns)
    x, y, z = (T @ [0.0, 6.0, 0.0, 1.0])[:3]
    return Block(float(x), float(y), 1.0, 1.0, float(z) - 0.2, float(z) + 2.0, 0.3)


def test_truth_is_where_beams_meet_the_object_and_nothing_else_is(scene):
    box, scans = box_before(scene), scene.scans
    new, gone, crossed = Painter(scene, [box], 0), Painter(scene, [], 0), Painter(scene, [], 0)
    painted = list(new.paint(scans))
    moved = sum(int((a.points_m != b.points_m).any(axis=1).sum()) for a, b in zip(painted, scans, strict=True))
    assert moved > 500
    static = Cells.of(scene.accumulated(map(scene.refined, scans)))
    truth = truth_of(static, new, gone, crossed, np.empty(0, np.int64))
    assert len(truth.new) >= 4
    assert not len(truth.deleted)
    assert (static.cells_at(truth.new) < 5).all()
    assert (Cells.of(new.on_objects).cells_at(truth.new) >= 20).all()
    assert not np.isin(truth.new, truth.ignored).any()
    on_ground = np.setdiff1d(Cells.of(new.on_objects).keys, truth.new)
    assert np.isin(on_ground, truth.ignored).all()


def test_what_an_object_in_the_map_hides_counts_for_nothing(scene):
    painter = Painter(scene, [box_before(scene)], 0)
    before = Cells.of(scene.accumulated(map(scene.refined, scene.scans)))
    after = Cells.of(scene.accumulated(map(scene.refined, painter.paint(scene.scans))))
    hidden = changed_by_shadow(before, after)
    assert (before.count_at(hidden) != after.count_at(hidden)).all()
    assert 0 < len(hidden) < len(before.keys)


@pytest.mark.slow
def test_a_whole_run(street_drive, tmp_path):
    out, result = tmp_path / "out", tmp_path / "a.json"
    arguments = ["--scans", street_drive, "--rounds", "1", "--first", "16", "--out", out, "--json", result]
    done = CliRunner().invoke(real, list(map(str, arguments)), catch_exceptions=False)
    assert done.exit_code == 0
    assert "Objects inserted" in done.output
    found = json.loads(result.read_text())
    assert found["scans"] == 16
    assert found["inserted"]["new"]["true"] >= 8
    assert found["inserted"]["new"]["recall"] >= 0.6
    assert found["inserted"]["deleted"]["recall"] >= 0.8
    untouched = found["untouched"]
    assert untouched["observed"] == untouched["observed_gaussian"] + untouched["observed_empty"]
    assert untouched["false_per_1000"] <= 5.0
    assert {name: sum(causes.values()) for name, causes in untouched["causes"].items()} == untouched["false"]


@pytest.mark.slow
def test_poses_of_the_vehicles_own_localiser(street_drive):
    found = reproduce_real(RealOptions(street_drive, rounds=1, objects=0, poses="estimated"), no_progress)
    assert found["scans_driven"] >= 6
    assert found["untouched"]["observed"] > 1000
    assert found["inserted"]["new"]["recall"] is None


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"drive_scans": "even"}, "share 8 of 16 scans"),
        ({"map_scans": "third"}, "expected all, even"),
        ({"changes": ("new_cell=3",)}, "--set: there is no setting new_cell; did you mean new_cells"),
        ({"changes": ("new_cells=many",)}, "--set new_cells: expected int, got str 'many'"),
        ({"changes": ("new_cells=3",)}, "new_cells = 3.* lies outside 20"),
        ({"rounds": 0}, "--rounds must be at least 1"),
        ({"kind": "bag"}, "format 'bag' is not known"),
        ({"scans": Path("nowhere")}, "no such file or folder"),
    ],
)
def test_wrong_options_are_told_in_one_line(street_drive, given, message):
    with pytest.raises(GndError, match=message) as caught:
        reproduce_real(RealOptions(**{"scans": street_drive, **given}), no_progress)
    assert "\n" not in str(caught.value)


def test_too_few_scans(street_drive):
    with pytest.raises(RealDataError, match="3 usable scans"):
        load(open_recording("auto", street_drive), 3, no_progress)


def test_parameters_replaced_one_by_one():
    found = changed(DetectParameters(), ["new_cells=33", "range_max_m=40"])
    assert (found.new_cells, found.range_max_m) == (33, 40.0)
