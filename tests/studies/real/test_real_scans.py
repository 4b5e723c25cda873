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
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.errors import GndError
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.importer import no_progress, open_recording
from studies.frame.errors import RealDataError
from studies.real.bands import DISTANCES_M, angles_deg, distance_m, inside
from studies.real.drive import FoundVoxels
from studies.real.rounds import KINDS, CellSurroundings, Painter, changed_by_shadow, choose_places, looked_at, truth_of
from studies.real.scene import Cells, RecordedScans, RecordedScene, centres_m, keys_of, load, origin_of, place
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


def found_of(keys: list[int], change: list[ChangeClass], in_map: list[bool], **columns: object) -> FoundVoxels:
    """Voxels of a drive; whatever is not given is nothing."""
    n = len(keys)
    plain = {
        "g": np.zeros((n, 3), np.int64), "mean_m": np.zeros((n, 3)), "surface_m": np.zeros((n, 3)),
        "normal": np.zeros((n, 3)), "hits": np.zeros(n, np.int64), "passes": np.zeros(n, np.int64), "scans_used": 1,
    }  # fmt: skip
    given = plain | {name: np.asarray(column) for name, column in columns.items()}
    return FoundVoxels(np.array(keys), change_class=np.array(change, np.uint8), in_map=np.array(in_map), **given)


def test_the_map_looked_where_its_rays_met_the_surface_not_where_they_crossed_the_voxel():
    """Ten thousand rays over a road pass its voxel, none of them through the road: it was not seen."""
    c = ChangeClass
    mapping = found_of(
        [1, 2, 3, 4, 5], [c.UNMEASURED, c.UNMEASURED, c.NORMAL, c.EMPTY, c.UNMEASURED],
        [True, True, True, False, False], hits=[0, 8, 30, 0, 0], passes=[0, 12, 0, 50, 2],
    )  # fmt: skip
    assert looked_at(mapping).tolist() == [2, 3, 4]


def test_voxels_are_found_again_by_their_keys(scene):
    found = found_of([9, 3, 7], [ChangeClass.NEW] * 3, [False] * 3)
    assert found.rows(np.array([3, 4, 9])).tolist() == [1, -1, 0]
    g = np.random.default_rng(1).integers(-300, 300, (200, 3)) + origin_of(scene.grid_frame)
    expected = scene.grid_frame.centre_map_m(g)
    np.testing.assert_allclose(centres_m(scene.grid_frame, keys_of(scene.grid_frame, g)), expected, atol=1e-9)


def test_angle_and_distance_of_a_surface_are_those_of_the_nearest_place():
    """Road 1.7 m below the LiDAR: steep near it, grazing 30 m on; a wall across the way meets rays at right angles."""
    from_m = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    at_m = np.array([[10.0, 0.0, -1.7], [40.0, 0.0, -1.7], [40.0, 0.0, 0.0], [40.0, 0.0, 0.0]])
    normal = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    found = found_of([1, 2, 3, 4], [ChangeClass.NORMAL] * 4, [True] * 4, surface_m=at_m, normal=normal)
    angle = angles_deg(from_m, found)
    np.testing.assert_allclose(angle[:3], [90.0, np.rad2deg(np.arctan(1.7 / 30.0)), 90.0], atol=1e-6)
    assert np.isnan(angle[3])
    np.testing.assert_allclose(distance_m(from_m, at_m[:2]), [1.7, np.hypot(30.0, 1.7)])
    assert inside(np.array([9.9, 10.0, np.nan]), DISTANCES_M["10-25 m"]).tolist() == [False, True, False]


@pytest.mark.slow
def test_half_a_drive_on_the_other_half(street_drive):
    """An empty street, nothing changed: much of what is new lies where the first half never looked."""
    found = reproduce_real(RealOptions(street_drive, split="halves", rounds=1, objects=4), no_progress)
    all_of_it, seen = found["untouched"], found["untouched_seen"]
    assert all_of_it["false"]["new"] > 30
    assert seen["false"]["new"] < 0.7 * all_of_it["false"]["new"]
    assert seen["false"]["deleted"] == all_of_it["false"]["deleted"]
    by = seen["by"]
    assert all(sum(row["gaussians"] for row in bands.values()) == seen["observed_gaussian"] for bands in by.values())
    for name in ("new", "deleted"):
        one = found["inserted"][name]
        assert sum(row["found"] for row in one["by_distance"].values()) == one["found"]
        assert one["precision_seen"] >= one["precision"]


def test_the_halves_of_a_drive():
    options = RealOptions(Path("drive"), split="halves")
    assert [half.tolist() for half in options.halves(6)] == [[0, 1, 2], [3, 4, 5]]
    assert [half.tolist() for half in RealOptions(Path("drive")).halves(6)] == [[0, 2, 4], [1, 3, 5]]
    with pytest.raises(RealDataError, match="--map-scans all and --drive-scans second-half share 3 of 6 scans"):
        RealOptions(Path("drive"), split="halves", map_scans="all").halves(6)


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
        ({"changes": ("new_cells=3",)}, "new_cells = 3.* lies outside 10"),
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
