import ast
import inspect
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from sim_worlds import BOTH, COARSE, small_world, thing

import gnd.fleet_sim.dense_rays
import gnd.fleet_sim.dense_scan
import gnd.fleet_sim.truth
from gnd.fleet_sim import parts
from gnd.fleet_sim.dense_scan import (
    AFTER_COME,
    BEFORE_GONE,
    CELLS,
    KNOWN_BEFORE,
    STANDS_AFTER,
    DenseScan,
    DenseWindow,
    _mark,
    _pass,
    _shell,
    _unexplained,
    dense_scan,
    world_grid,
)
from gnd.fleet_sim.errors import TruthError
from gnd.fleet_sim.truth import (
    CHANGES,
    Truth,
    TruthRules,
    classify,
    load_or_make_truth,
    make_truth,
    marginal,
    read_truth,
    world_sha,
    write_truth,
)
from gnd.fleet_sim.world import World
from gnd.gnd_map.classes import ChangeClass


def class_at(truth: Truth, world: World, x: float, y: float, z: float) -> ChangeClass:
    """The class of the voxel around a point of the street frame."""
    grid = world_grid(world)
    g = np.floor(grid.grid_of(world.map_of_street(np.array([[x, y, z]])))).astype(np.int64)
    morton, voxel_id = grid.tile_voxel_of(g)
    at = np.flatnonzero((truth.morton == morton[0]) & (truth.voxel_id == voxel_id[0]))
    assert len(at) == 1, "no ray touched this voxel"
    return ChangeClass(int(truth.change_class[at[0]]))


def majority(truth: Truth, world: World, x0: float, x1: float, y: float, z: float) -> ChangeClass:
    """The class of most voxels along a line of the street frame."""
    found = [class_at(truth, world, float(x), y, z) for x in np.linspace(x0, x1, 15)]
    return max(set(found), key=found.count)


@pytest.mark.parametrize(
    ("name", "line", "expected"),
    [
        ("a wall that stays", (-10.5, -7.5, 8.0, 1.2), ChangeClass.NORMAL),
        ("a wall that goes", (-4.5, -1.5, 8.0, 1.2), ChangeClass.DELETED),
        ("a wall that comes", (1.5, 4.5, 8.0, 1.2), ChangeClass.NEW),
        ("the container's front", (-0.3, 3.3, -6.2, 1.2), ChangeClass.NEW),
        ("a wall that the container hides", (0.5, 2.5, -9.1, 1.0), ChangeClass.NORMAL),
        ("a wall that the vanished one revealed", (-3.5, -2.5, 9.0, 1.0), ChangeClass.NEW),
        ("the air over the road", (-5.0, 5.0, 0.0, 1.5), ChangeClass.EMPTY),
        ("the road", (-5.0, 5.0, 0.0, 0.0), ChangeClass.NORMAL),
    ],
)
def test_classes_are_what_was_built(
    edited: Truth,
    edited_world: World,
    name: str,
    line: tuple[float, float, float, float],
    expected: ChangeClass,
) -> None:
    assert majority(edited, edited_world, *line) == expected, name


def test_a_moved_wall_is_modified_or_deleted_and_new(edited: Truth, edited_world: World) -> None:
    """Moved by 0.5 m: one voxel holds both places (modified), or one each (deleted, new); never normal or empty."""
    old = {class_at(edited, edited_world, float(x), -8.0, 1.2) for x in np.linspace(-10, -6, 15)}
    new = {class_at(edited, edited_world, float(x), -8.5, 1.2) for x in np.linspace(-10, -6, 15)}
    assert old <= {ChangeClass.MODIFIED, ChangeClass.DELETED}
    assert new <= {ChangeClass.MODIFIED, ChangeClass.NEW}


def test_a_wall_moved_by_a_hand_inside_its_voxels_is_modified() -> None:
    wall = parts.slab
    world = small_world(
        thing("moves", ("before",), "moved", wall(-8, 8, 8.0, 8.3, -0.2, 3.0)),
        thing("moves", ("after",), "moved", wall(-8, 8, 8.35, 8.65, -0.2, 3.0)),
    )
    truth = make_truth(world, plan=COARSE)
    counts = {c.name.lower(): int((truth.change_class[truth.clear] == c).sum()) for c in CHANGES}
    assert counts["modified"] >= 8


def test_a_world_without_edits_has_no_changes() -> None:
    world = small_world(thing("wall", BOTH, "kept", parts.slab(-8, 8, 8.0, 8.3, -0.2, 3.0)))
    counts = make_truth(world, plan=COARSE).counts("all")
    assert (counts["new"], counts["modified"], counts["deleted"]) == (0, 0, 0)
    assert counts["normal"] > 500


def test_levels_are_nested_and_scored_voxels_are_near(edited: Truth, edited_world: World) -> None:
    masks = [edited.mask(level) for level in ("all", "observable", "scored")]
    assert masks[0].all()
    for wide, narrow in pairwise(masks):
        assert not np.any(narrow & ~wide)
        assert 0 < narrow.sum() < wide.sum()
    with pytest.raises(TruthError, match="unknown level"):
        edited.mask("best")  # type: ignore[arg-type]


def test_the_hidden_wall_is_not_scored_and_the_road_is(edited: Truth, edited_world: World) -> None:
    grid = world_grid(edited_world)

    def scored(x: float, y: float, z: float) -> bool:
        g = np.floor(grid.grid_of(edited_world.map_of_street(np.array([[x, y, z]])))).astype(np.int64)
        morton, voxel_id = grid.tile_voxel_of(g)
        return bool(edited.mask("scored")[(edited.morton == morton[0]) & (edited.voxel_id == voxel_id[0])].any())

    assert not any(scored(x, -9.1, 1.0) for x in (0.5, 1.5, 2.5))
    assert any(scored(float(x), y, 0.0) for x in np.linspace(-6, 6, 13) for y in (-1.0, 0.0, 1.0))


def test_the_rules_are_fixed() -> None:
    """Whoever changes a rule changes every score ever reported: do it knowingly, and here too."""
    assert asdict(TruthRules()) == {
        "n_min_cells": 20,
        "modified_share": 0.25,
        "marginal_share": (0.125, 0.5),
        "marginal_cells": (10, 40),
        "shell_cells": 10,
        "revealed_share": 0.25,
        "reach_m": 20.0,
        "end_m": 5.0,
        "low_m": -1.0,
        "high_m": 8.0,
        "seen_cells": 40,
        "passes": 30,
    }


@pytest.mark.parametrize("module", [gnd.fleet_sim.truth, gnd.fleet_sim.dense_scan, gnd.fleet_sim.dense_rays])
def test_truth_uses_nothing_of_the_method(module: object) -> None:
    tree = ast.parse(inspect.getsource(module))  # type: ignore[arg-type]
    imports = {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
    allowed = {
        f"gnd_map.{m}" for m in ("accumulate", "classes", "gaussian", "geodesy", "grid", "jit", "near_grid", "tile_id")
    }
    assert {
        m for m in imports if m and m.startswith(("gnd_map", "vehicle_agent", "cloud_merger", "tile_store"))
    } <= allowed


def test_truth_gaussians_follow_the_rule_of_the_accumulator(edited_world: World) -> None:
    scan = dense_scan(edited_world, COARSE)
    for accumulator, flags in ((scan.before, KNOWN_BEFORE), (scan.after, STANDS_AFTER)):
        g, moments = accumulator.moments()
        inside = np.isin(_keys(g), _keys(scan.g))
        assert inside.all()
        counts = scan.count(flags)
        order = np.searchsorted(_keys(scan.g), _keys(g))
        np.testing.assert_array_equal(moments.cells, counts[order])
        assert counts.sum() == moments.cells.sum()


def _keys(g: np.ndarray) -> np.ndarray:
    shifted = g.astype(np.int64) - [27_700_000, 14_400_000, -100]
    return (shifted[:, 0] * 2**20 + shifted[:, 1]) * 2**10 + shifted[:, 2]


# Plain twins of the counting kernels, on random cells.

WINDOW = DenseWindow(100, 200, -5, 4, 5, 3)


def random_cells(seed: int) -> tuple[np.ndarray, np.ndarray, dict[tuple[int, int, int], int]]:
    """Rows and cells as the kernels keep them, and the same as a plain mapping from sub-cell to flags."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([99, 199, -6], [105, 206, -1], (3000, 3))
    flags = rng.choice(np.array([1, 2, 4, 8, 0], dtype=np.uint8), 3000)
    index = np.full(WINDOW.nx * WINDOW.ny * WINDOW.nz, -1, np.int32)
    cells = np.zeros((200, CELLS**3), np.uint8)
    used = _mark(points, flags, WINDOW, index, cells, 0)
    plain: dict[tuple[int, int, int], int] = {}
    low, size = np.array(WINDOW[:3]), np.array(WINDOW[3:])
    for p, flag in zip(points, flags, strict=True):
        if flag and np.all(np.floor(p) >= low) and np.all(np.floor(p) < low + size):
            v = np.floor(p)
            key = tuple(((v - low) * CELLS + np.floor((p - v) * CELLS)).astype(int).tolist())
            plain[key] = plain.get(key, 0) | int(flag)
    return index, cells[:used], plain


def voxel_of(cell: tuple[int, int, int]) -> tuple[int, int, int]:
    return cell[0] // CELLS, cell[1] // CELLS, cell[2] // CELLS


def slot_of(voxel: tuple[int, int, int]) -> int:
    return (voxel[0] * WINDOW.ny + voxel[1]) * WINDOW.nz + voxel[2]


def test_marked_cells_are_those_of_the_plain_twin() -> None:
    index, cells, plain = random_cells(0)
    total = 0
    for cell, flags in plain.items():
        x, y, z = (c % CELLS for c in cell)
        assert cells[index[slot_of(voxel_of(cell))], (z * CELLS + y) * CELLS + x] == flags
        total += 1
    assert np.count_nonzero(cells) == total


def test_a_full_table_is_reported() -> None:
    index = np.full(WINDOW.nx * WINDOW.ny * WINDOW.nz, -1, np.int32)
    points = np.array([[100.5, 200.5, -4.5], [101.5, 200.5, -4.5]])
    assert _mark(points, np.ones(2, np.uint8), WINDOW, index, np.zeros((1, 1000), np.uint8), 0) == -1


@pytest.mark.parametrize("seed", [1, 2])
def test_unexplained_cells_are_those_of_the_plain_twin(seed: int) -> None:
    index, cells, plain = random_cells(seed)
    expected = np.zeros((len(cells), 3), int)
    around = [(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)]
    for cell, flags in plain.items():
        near = 0
        for i, j, k in around:
            near |= plain.get((cell[0] + i, cell[1] + j, cell[2] + k), 0)
        row = index[slot_of(voxel_of(cell))]
        if flags & KNOWN_BEFORE and flags & STANDS_AFTER:
            continue
        if flags & BEFORE_GONE:
            expected[row, 0] += not near & STANDS_AFTER
        else:
            expected[row, 1 if flags & AFTER_COME else 2] += not near & KNOWN_BEFORE
    found = _unexplained(WINDOW, index, cells, len(cells))
    np.testing.assert_array_equal(found, expected)
    assert found.sum() > 100


def test_shell_cells_are_those_of_the_plain_twin() -> None:
    index, cells, plain = random_cells(3)
    touched = np.arange(len(index))
    expected = np.zeros((len(index), 2), int)
    for cell, flags in plain.items():
        for axis in range(3):
            for layer, side in ((0, -1), (CELLS - 1, 1)):
                voxel = list(voxel_of(cell))
                voxel[axis] += side
                if cell[axis] % CELLS == layer and 0 <= voxel[axis] < WINDOW[3 + axis]:
                    slot = slot_of((voxel[0], voxel[1], voxel[2]))
                    expected[slot] += [bool(flags & KNOWN_BEFORE), bool(flags & STANDS_AFTER)]
    np.testing.assert_array_equal(_shell(WINDOW, index, cells, touched), expected)
    assert expected.sum() > 100


def test_passed_voxels_are_those_that_a_finely_sampled_ray_visits() -> None:
    rng = np.random.default_rng(4)
    passes = np.zeros(WINDOW.nx * WINDOW.ny * WINDOW.nz, np.int32)
    origin, ends = np.array([101.3, 201.2, -3.6]), rng.uniform([98, 198, -7], [106, 207, 0], (40, 3))
    _pass(origin, ends, WINDOW, passes)
    expected = np.zeros_like(passes)
    for end in ends:
        samples = np.floor(origin + np.linspace(0.0, 1.0, 4001)[:, None] * (end - origin)).astype(int)
        visited = {tuple(v) for v in (samples - np.array(WINDOW[:3])).tolist()}
        visited.discard(tuple((np.floor(end) - WINDOW[:3]).astype(int).tolist()))
        for v in visited:
            if all(0 <= v[a] < WINDOW[3 + a] for a in range(3)):
                expected[slot_of(v)] += 1
    assert np.abs(passes - expected).sum() <= 2, "a corner may be cut between two samples"


def scan_of_one(counts: dict[str, int], shell: tuple[int, int], unexplained: tuple[int, int, int]) -> DenseScan:
    """A dense scan of one voxel with given numbers of sub-cells."""
    cells = np.zeros((1, CELLS**3), np.uint8)
    start = 0
    for flags, count in counts.items():
        cells[0, start : start + count] = int(flags)
        start += count
    return DenseScan(
        None, np.zeros((1, 3), np.int32), cells, np.zeros(1, np.int32), np.zeros((1, 2), np.int32),  # type: ignore[arg-type]
        np.array([unexplained], np.int32), np.array([shell], np.int32), None, None,  # type: ignore[arg-type]
    )  # fmt: skip


@pytest.mark.parametrize(
    ("counts", "shell", "unexplained", "expected", "hair"),
    [
        ({"1": 80}, (0, 0), (0, 0, 0), ChangeClass.NORMAL, False),
        ({"1": 30}, (0, 0), (0, 0, 0), ChangeClass.NORMAL, True),
        ({"2": 80}, (0, 0), (80, 0, 0), ChangeClass.DELETED, False),
        ({"2": 80}, (0, 12), (80, 0, 0), ChangeClass.DELETED, True),
        ({"8": 80}, (0, 0), (0, 80, 0), ChangeClass.NEW, False),
        ({"8": 80, "2": 15}, (0, 0), (15, 80, 0), ChangeClass.NEW, True),
        ({"4": 80}, (0, 0), (0, 0, 80), ChangeClass.NEW, False),
        ({"1": 60, "8": 60}, (0, 0), (0, 60, 0), ChangeClass.MODIFIED, False),
        ({"1": 60, "8": 20}, (0, 0), (0, 20, 0), ChangeClass.MODIFIED, True),
        ({"1": 100, "8": 20}, (0, 0), (0, 20, 0), ChangeClass.NORMAL, True),
        ({"1": 100, "8": 10}, (0, 0), (0, 10, 0), ChangeClass.NORMAL, False),
        ({"1": 60, "4": 60}, (0, 0), (0, 0, 60), ChangeClass.NORMAL, True),
        ({}, (0, 0), (0, 0, 0), ChangeClass.EMPTY, False),
        ({}, (10, 10), (0, 0, 0), ChangeClass.EMPTY, True),
        ({"1": 9}, (0, 0), (0, 0, 0), ChangeClass.EMPTY, False),
        ({"1": 12}, (0, 0), (0, 0, 0), ChangeClass.EMPTY, True),
    ],
)
def test_the_rules_case_by_case(
    counts: dict[str, int],
    shell: tuple[int, int],
    unexplained: tuple[int, int, int],
    expected: ChangeClass,
    hair: bool,
) -> None:
    scan = scan_of_one(counts, shell, unexplained)
    assert ChangeClass(int(classify(scan, TruthRules())[0])) == expected
    assert bool(marginal(scan, TruthRules())[0]) == hair


def test_a_truth_is_read_back_as_written(edited: Truth, tmp_path: Path) -> None:
    path = tmp_path / "truth.npz"
    write_truth(edited, path)
    again = read_truth(path)
    for name in ("morton", "voxel_id", "change_class", "clear", "observable"):
        np.testing.assert_array_equal(getattr(again, name), getattr(edited, name))
    assert again.before == dict(edited.before)
    assert again.after == dict(edited.after)
    assert (again.frame, again.world_sha, again.plan) == (edited.frame, edited.world_sha, COARSE)
    assert [p.name for p in tmp_path.iterdir()] == ["truth.npz"]


@pytest.mark.parametrize("damage", ["missing", "empty", "cut", "other"])
def test_a_damaged_truth_file_is_refused(damage: str, edited: Truth, tmp_path: Path) -> None:
    path = tmp_path / "truth.npz"
    write_truth(edited, path)
    whole = path.read_bytes()
    match damage:
        case "missing":
            path.unlink()
        case "empty":
            path.write_bytes(b"")
        case "cut":
            path.write_bytes(whole[: len(whole) // 2])
        case "other":
            with path.open("wb") as file:
                np.savez(file, head=np.array('{"format": "else"}'))
    with pytest.raises(TruthError, match=r"truth\.npz"):
        read_truth(path)


def test_a_kept_truth_is_used_only_for_its_own_world(edited: Truth, edited_world: World, tmp_path: Path) -> None:
    path = tmp_path / "truth.npz"
    write_truth(edited, path)
    stamp = path.stat().st_mtime_ns
    assert load_or_make_truth(edited_world, path, COARSE).world_sha == world_sha(edited_world)
    assert path.stat().st_mtime_ns == stamp, "not made again"
    other = replace(edited_world, half_length_m=4.0)
    assert load_or_make_truth(other, path, COARSE).world_sha == world_sha(other) != edited.world_sha
    assert path.stat().st_mtime_ns != stamp


def test_the_same_world_gives_the_same_truth(edited: Truth, edited_world: World) -> None:
    again = make_truth(edited_world, plan=COARSE)
    np.testing.assert_array_equal(again.change_class, edited.change_class)
    assert again.after == dict(edited.after)


@pytest.mark.slow
def test_the_street_has_a_few_hundred_voxels_of_every_class(truth_1: tuple[Truth, Path]) -> None:
    counts = truth_1[0].counts("scored")
    assert min(counts[name] for name in ("new", "modified", "deleted")) >= 250
    assert counts["normal"] > 5000
    everything = truth_1[0].counts("all")
    changed = everything["new"] + everything["modified"] + everything["deleted"]
    assert 0.12 < changed / (changed + everything["normal"]) < 0.3
