"""TUM and KITTI files: what is written is read again, the bytes are known, what is no pose is refused by line."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_from_R_t, exp_so3
from gnd.schemas.errors import TrajectoryError
from gnd.schemas.trajectory_files import (
    kitti_text,
    nanoseconds,
    read_kitti,
    read_tum,
    seconds,
    times_text,
    tum_text,
    write_kitti,
    write_times,
    write_tum,
)

T0_NS = 1_570_838_400_049_971_456
TIMES = st.lists(st.integers(0, 4_000_000_000_000_000_000), min_size=0, max_size=6, unique=True).map(sorted)


@st.composite
def trajectories(draw: st.DrawFn) -> Trajectory:
    t_ns = draw(TIMES)
    number = st.floats(-1e6, 1e6, allow_nan=False)
    turn = st.floats(-4.0, 4.0, allow_nan=False)
    rows = [[*draw(st.tuples(turn, turn, turn)), *draw(st.tuples(number, number, number))] for _ in t_ns]
    values = np.array(rows, np.float64).reshape(-1, 6)
    return Trajectory(np.array(t_ns, np.int64), T_from_R_t(exp_so3(values[:, :3]), values[:, 3:]))


def two_poses() -> Trajectory:
    """One at rest, one turned left by 90 degrees."""
    T = np.stack([np.eye(4), T_from_R_t(exp_so3([0.0, 0.0, np.pi / 2]), [1.5, -2.0, 0.25])])
    return Trajectory(np.array([T0_NS, T0_NS + 100_000_000], np.int64), T)


def same(a: Trajectory, b: Trajectory) -> bool:
    return np.array_equal(a.t_ns, b.t_ns) and bool(np.allclose(a.T_dst_vehicle, b.T_dst_vehicle, rtol=0, atol=3e-9))


@given(poses=trajectories())
def test_tum_gives_back_times_exactly_and_poses_to_a_nanometre(
    poses: Trajectory, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "round.tum"
    write_tum(path, poses, "two lines\nof comment")
    assert same(read_tum(path), poses)


@given(poses=trajectories())
def test_kitti_gives_back_times_exactly_and_poses_to_a_nanometre(
    poses: Trajectory, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.getbasetemp()
    write_kitti(folder / "round.kitti", poses)
    write_times(folder / "round.txt", poses.t_ns)
    assert same(read_kitti(folder / "round.kitti", folder / "round.txt"), poses)


@given(t_ns=st.integers(0, 2**62))
def test_times_lose_nothing_as_text(t_ns: int) -> None:
    assert nanoseconds(seconds(t_ns)) == t_ns


@given(poses=trajectories())
def test_quaternions_are_what_scipy_makes_of_the_rotation(poses: Trajectory) -> None:
    rows = np.array([line.split() for line in tum_text(poses).splitlines()], np.float64).reshape(-1, 8)
    expected = Rotation.from_matrix(poses.T_dst_vehicle[:, :3, :3]).as_matrix() if len(poses) else np.empty((0, 3, 3))
    found = Rotation.from_quat(rows[:, 4:]).as_matrix() if len(rows) else expected
    assert np.allclose(found, expected, atol=1e-8)
    assert (rows[:, 7] >= 0).all()


def test_the_bytes_of_tum_are_these() -> None:
    assert tum_text(two_poses(), "made by hand") == (
        "# made by hand\n"
        "1570838400.049971456 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 1.000000000\n"
        "1570838400.149971456 1.500000000 -2.000000000 0.250000000 0.000000000 0.000000000 0.707106781 0.707106781\n"
    )


def test_the_bytes_of_kitti_and_its_times_are_these() -> None:
    assert kitti_text(two_poses()) == (
        "1.000000000 0.000000000 0.000000000 0.000000000 0.000000000 1.000000000 0.000000000 0.000000000"
        " 0.000000000 0.000000000 1.000000000 0.000000000\n"
        "0.000000000 -1.000000000 0.000000000 1.500000000 1.000000000 0.000000000 0.000000000 -2.000000000"
        " 0.000000000 0.000000000 1.000000000 0.250000000\n"
    )
    assert times_text(two_poses().t_ns) == "1570838400.049971456\n1570838400.149971456\n"


def test_files_of_other_programs_are_read(tmp_path: Path) -> None:
    """Six digits, exponents, comments, empty lines, any white space; rotations come back orthonormal."""
    path = tmp_path / "other.tum"
    path.write_text("# timestamp tx ty tz\n\n1.5e+00\t1 2 3  0 0 0.707107 0.707107\n  2 1 2 3 0 0 -0.5 -0.866025\n")
    poses = read_tum(path)
    assert poses.t_ns.tolist() == [1_500_000_000, 2_000_000_000]
    R = poses.T_dst_vehicle[:, :3, :3]
    assert np.allclose(R @ np.swapaxes(R, 1, 2), np.eye(3), atol=1e-12)
    assert np.allclose(R[1], exp_so3([0, 0, np.pi / 3]), atol=1e-5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n", r"line 1: expected a time and 7 numbers, found 3 words"),
        ("# x\n1 0 0 0 0 0 0 1\n2 0 0 zero 0 0 0 1\n", r"line 3: 'zero' is no number"),
        ("1 0 0 nan 0 0 0 1\n", r"line 1: 'nan' is not finite"),
        ("1 0 0 0 0 0 0 2\n", r"line 1: quaternion has length 2"),
        ("-1 0 0 0 0 0 0 1\n", r"line 1: time '-1' is not between"),
        ("2 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n", r"pose 2 of 2 is not later"),
    ],
)
def test_what_is_no_pose_is_refused_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.tum"
    path.write_text(text)
    with pytest.raises(TrajectoryError, match=message) as caught:
        read_tum(path)
    assert str(caught.value).startswith(str(path))


def test_kitti_refuses_what_is_no_rotation_and_times_that_do_not_fit(tmp_path: Path) -> None:
    poses, times = tmp_path / "a.kitti", tmp_path / "a.txt"
    times.write_text("1\n2\n")
    poses.write_text("1 0 0 0 0 1 0 0 0 0 -1 0\n")
    with pytest.raises(TrajectoryError, match="line 1: pose is not a rigid transform"):
        read_kitti(poses, times)
    poses.write_text("2 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(TrajectoryError, match="rotation is off by 3"):
        read_kitti(poses, times)
    poses.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(TrajectoryError, match=r"has 1 poses, .* has 2 times"):
        read_kitti(poses, times)


def test_a_missing_file_and_a_missing_folder_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(TrajectoryError, match="no such file"):
        read_tum(tmp_path / "none.tum")
    with pytest.raises(TrajectoryError, match="cannot write"):
        write_tum(tmp_path / "none" / "a.tum", two_poses())
    assert list(tmp_path.iterdir()) == []
