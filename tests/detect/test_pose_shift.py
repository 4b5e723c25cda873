"""Pose errors are told from changes of the world, and where they cannot be told it is said."""

import numpy as np
import pytest
from gate_scene import CORRIDOR, POSE, WALLS, Wall, map_of, match_maps, seen, shift
from numpy.typing import NDArray

from gnd.gnd_map.se3 import T_inverse, transform
from gnd.vehicle_agent.detect.fit_kernel import UNKNOWN_COST
from gnd.vehicle_agent.detect.shift import OF_SCANS, Shift, costs_at, find_shift
from gnd.vehicle_agent.detect.uncertainty import PoseUncertainty
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.match_map import MatchMap

PARAMETERS, SURE = OF_SCANS, PoseUncertainty(0.01, 0.0005)
ERRORS = {
    "10 cm ahead": shift(0.1),
    "20 cm left": shift(0.0, 0.2),
    "50 cm aslant": shift(0.35, -0.35),
    "1 m back": shift(-1.0),
    "half a degree": shift(yaw_deg=0.5),
    "a degree and 30 cm": shift(0.0, 0.3, -1.0),
    "20 cm up": shift(z_m=0.2),
}


@pytest.fixture(scope="module")
def yard() -> LocalMap:
    return map_of()


def found(local_map: LocalMap, points_map_m: NDArray[np.float64], error: NDArray[np.float64]) -> Shift:
    """The shift test at a pose that is off by `error`, of points that are right."""
    return find_shift(transform(T_inverse(POSE), points_map_m), POSE @ error, match_maps(local_map).near(POSE[:3, 3]))


def rebuilt(moved_m: float) -> list[Wall]:
    """The walls of the yard's north side stand farther north."""
    north = [((a[0], a[1] + moved_m), (b[0], b[1] + moved_m)) for a, b in WALLS[1:3]]
    return [WALLS[0], *north, *WALLS[3:]]


def plain_costs(points: NDArray[np.float64], T: NDArray[np.float64], m: MatchMap) -> list[float]:
    """The kernel's twin: one point and one neighbour after the other."""
    costs = []
    for point in transform(T, points):
        g = m.A @ point + m.b
        inside = (g >= 1).all() and (g < np.array(m.index.shape) - 1).all()
        i = tuple(int(v) for v in g)
        if not inside or m.index[i] < -1:
            costs.append(UNKNOWN_COST)
            continue
        best = np.inf
        for step in ((0, 0, 0), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)):
            row = m.index[i[0] + step[0], i[1] + step[1], i[2] + step[2]]
            if row >= 0:
                xx, xy, xz, yy, yz, zz = m.information[row]
                d = point - m.mean_m[row]
                best = min(best, float(d @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ d))
        costs.append(best / (4.0 + best) if np.isfinite(best) else 1.0)
    return costs


def test_the_kernel_and_its_plain_twin_agree(yard: LocalMap) -> None:
    high_up = POSE[:3, 3] + np.array([[3.0, 2.0, 6.0]])  # in the air
    points = np.concatenate([seen(WALLS, 3)[::40], [[500.0, 0.0, 0.0]], np.zeros((1, 3)), high_up])
    match_map = match_maps(yard).near(POSE[:3, 3])
    kernel = costs_at(points, shift(0.3, -0.2, 0.7), match_map)
    assert np.allclose(kernel, plain_costs(points, shift(0.3, -0.2, 0.7), match_map), atol=1e-9)
    assert (kernel == UNKNOWN_COST).any()
    assert (kernel == 1.0).any()


def test_a_right_pose_in_an_unchanged_world_is_left_alone(yard: LocalMap) -> None:
    shift_found = found(yard, seen(WALLS, 4), np.eye(4))
    assert shift_found.checked
    assert shift_found.size_m < 0.03
    assert not shift_found.is_pose_error(PARAMETERS, SURE)


@pytest.mark.parametrize("error", ERRORS.values(), ids=ERRORS)
def test_a_pose_error_is_found_and_measured(yard: LocalMap, error: NDArray[np.float64]) -> None:
    shift_found = found(yard, seen(WALLS, 5), error)
    assert shift_found.is_pose_error(PARAMETERS, SURE)
    assert np.abs((error @ shift_found.T - np.eye(4))[:3, 3]).max() < 0.03
    assert np.abs((error @ shift_found.T - np.eye(4))[:3, :3]).max() < 0.002


@pytest.mark.parametrize("moved_m", [0.2, 0.5, 1.0, 3.0])
def test_a_building_site_is_no_pose_error(yard: LocalMap, moved_m: float) -> None:
    """One side of the yard stands elsewhere, all moved alike: what stayed says where the vehicle is."""
    shift_found = found(yard, seen(rebuilt(moved_m), 6), np.eye(4))
    assert not shift_found.is_pose_error(PARAMETERS, SURE)


@pytest.mark.parametrize("error", ERRORS.values(), ids=ERRORS)
def test_a_pose_error_beside_a_building_site_is_found(yard: LocalMap, error: NDArray[np.float64]) -> None:
    shift_found = found(yard, seen(rebuilt(1.5), 7), error)
    assert shift_found.is_pose_error(PARAMETERS, SURE)
    assert np.abs((error @ shift_found.T - np.eye(4))[:3, 3]).max() < 0.05


def test_along_a_corridor_nothing_is_claimed_and_across_it_an_error_is_found() -> None:
    corridor = map_of(CORRIDOR)
    along, across = (found(corridor, seen(CORRIDOR, 8), error) for error in (shift(0.5), shift(0.0, 0.3)))
    assert not along.checked
    assert not along.is_pose_error(PARAMETERS, SURE)
    assert across.is_pose_error(PARAMETERS, SURE)
    assert across.shift_m[1] == pytest.approx(-0.3, abs=0.03)


TRUCK: tuple[Wall, ...] = (((-9.0, 2.0), (9.0, 2.0)), ((-9.0, 4.4), (9.0, 4.4)))
"""Stands where the map has nothing: enough that does not fit, so that the search begins around the pose, too."""


@pytest.fixture(scope="module", params=[(150.0, 0.01), (20.0, 0.1)], ids=["even walls", "rough walls"])
def corridor(request: pytest.FixtureRequest) -> LocalMap:
    """The map of even walls has no information along them, that of rough walls has some, and it is of chance."""
    per_m2, noise_m = request.param
    return map_of(CORRIDOR, per_m2, noise_m)


@pytest.mark.parametrize("ahead_m", [0.0, 0.3, 0.5])
@pytest.mark.parametrize("seed", range(8, 12))
def test_along_a_corridor_nothing_is_found_together_with_a_little_across_it(
    corridor: LocalMap, ahead_m: float, seed: int
) -> None:
    """5 cm across are there and no finding; they must not take along what begins 60 cm ahead of the pose."""
    shift_found = found(corridor, seen((*CORRIDOR, *TRUCK), seed), shift(ahead_m, 0.05))
    assert shift_found.misfits > 0.05 * shift_found.voxels
    assert shift_found.z > PARAMETERS.z
    assert abs(shift_found.shift_m[0]) < 0.01
    assert not shift_found.is_pose_error(PARAMETERS, SURE)


@pytest.mark.parametrize(
    "error",
    [shift(0.0, 0.4), shift(0.5, 0.4), shift(0.0, -0.2), shift(0.3, 0.0, 0.5), shift(0.3, z_m=0.2)],
    ids=["40 cm across", "and along", "20 cm across", "half a degree", "20 cm up"],
)
def test_in_a_corridor_all_other_errors_are_found(corridor: LocalMap, error: NDArray[np.float64]) -> None:
    shift_found = found(corridor, seen((*CORRIDOR, *TRUCK), 8), error)
    assert shift_found.is_pose_error(PARAMETERS, SURE)
    left = error @ shift_found.T
    assert left[1:3, 3] == pytest.approx([0.0, 0.0], abs=0.05)
    assert np.abs(left[:3, :3] - np.eye(3)).max() < 0.003
    assert abs(shift_found.shift_m[0]) < 0.01


def test_what_no_test_can_tell_is_taken_for_a_pose_error(yard: LocalMap) -> None:
    """All that stands has moved alike: the ground alone does not say where the vehicle is. To be late is no harm."""
    all_moved = [((a[0] + 0.5, a[1]), (b[0] + 0.5, b[1])) for a, b in WALLS]
    assert found(yard, seen(all_moved, 9), np.eye(4)).is_pose_error(PARAMETERS, SURE)


def test_a_pose_that_says_how_poor_it_is_may_be_off_by_more_but_not_by_any_amount() -> None:
    assert PARAMETERS.limit_m(SURE) == 0.08
    assert PARAMETERS.limit_m(PoseUncertainty(0.04, 0.0)) == pytest.approx(0.12)
    assert PARAMETERS.limit_m(PoseUncertainty(0.0, 0.0016)) == pytest.approx(0.12)
    assert PARAMETERS.limit_m(PoseUncertainty(5.0, 0.0)) == 0.15


def test_nothing_known_is_nothing_checked(yard: LocalMap) -> None:
    far = found(yard, seen(WALLS, 4) + np.array([300.0, 0.0, 0.0]), np.eye(4))
    assert (far.voxels, far.checked, far.size_m) == (0, False, 0.0)
    assert found(yard, np.empty((0, 3)), np.eye(4)).voxels == 0


def test_heights_and_tilts_are_no_question_to_a_few_layers(yard: LocalMap) -> None:
    points = transform(T_inverse(POSE), seen(WALLS, 4))
    flat = find_shift(points, POSE @ shift(0.2, z_m=0.2), match_maps(yard).near(POSE[:3, 3]), planar=True)
    assert flat.shift_m[2] == 0.0
    assert np.abs(flat.turn_rad[:2]).max() == 0.0
