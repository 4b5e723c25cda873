from collections.abc import Iterable

import numpy as np
import pytest

from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.se3 import T_inverse, log_so3
from gnd.schemas.drive import DriveHeader, DriveItem, GnssFix, MotionSample, ReferencePose, Scan
from studies.localisation_study.variants import (
    ELSEWHERE_NS,
    MOUNT_M,
    MOUNT_RAD,
    OUTAGE_NS,
    VARIANTS,
    Variant,
    variant_of,
)

SECOND_NS = 1_000_000_000
MOUNT = np.eye(4)
MOUNT[:3, 3] = 1.2, 0.0, 1.9
HEADER = DriveHeader("d", "v", "VLP-16", LocalFrame(0.65, 2.2), MOUNT)


def scan(t_ns: int, n: int = 200) -> Scan:
    rng = np.random.default_rng(t_ns)
    points = np.ascontiguousarray(rng.normal(size=(n, 3)) * 20.0, dtype=np.float32)
    return Scan(t_ns, points, np.linspace(0, 99_000_000, n).astype(np.uint32))


def passed(variant: Variant, items: Iterable[DriveItem]) -> list[DriveItem]:
    return [item for given in items for item in variant.items(given)]


def drive(seconds: int = 60) -> list[DriveItem]:
    items: list[DriveItem] = []
    for tenth in range(10 * seconds):
        t_ns = SECOND_NS + tenth * 100_000_000
        items += [GnssFix(t_ns, 0.65, 2.2, 30.0, 2.5), MotionSample(t_ns, 9.0, 0.01), scan(t_ns)]
        items.append(ReferencePose(t_ns, np.eye(4)))
    return items


def test_the_drive_as_it_is() -> None:
    items = drive(2)
    assert passed(variant_of("", 1), items) == items
    assert variant_of("", 1).header(HEADER) == HEADER


@pytest.mark.parametrize("seed", range(5))
def test_the_mount_is_off_by_what_it_says_in_a_direction_of_the_seed(seed: int) -> None:
    off = T_inverse(MOUNT) @ variant_of("mount_error", seed).header(HEADER).T_vehicle_lidar
    assert np.linalg.norm(off[:3, 3]) == pytest.approx(MOUNT_M)
    assert np.linalg.norm(log_so3(off[:3, :3])) == pytest.approx(MOUNT_RAD)
    assert variant_of("mount_error", seed).header(HEADER) == variant_of("mount_error", seed).header(HEADER)
    assert variant_of("mount_error", seed).header(HEADER) != variant_of("mount_error", seed + 1).header(HEADER)


def test_wheel_scale_touches_speeds_only() -> None:
    items = drive(1)
    for before, after in zip(items, passed(variant_of("wheel_scale", 1), items), strict=True):
        if isinstance(before, MotionSample):
            assert after == MotionSample(before.t_ns, 9.0 * 1.02, 0.01)
        else:
            assert after is before


def test_the_outage_begins_with_the_first_pose_and_ends() -> None:
    variant, items = variant_of("gnss_outage", 1), drive(50)
    begin_ns, given = SECOND_NS * 4, []
    for item in items:
        variant.posed = item.t_ns >= begin_ns
        given += list(variant.items(item))
    missing = [item.t_ns for item in items if isinstance(item, GnssFix) and item not in given]
    assert (min(missing), max(missing)) == (begin_ns, begin_ns + OUTAGE_NS - 100_000_000)
    assert len(missing) == 300
    assert len(given) == len(items) - 300


def test_one_scan_in_twenty_is_another() -> None:
    items = drive(60)
    given = passed(variant_of("outlier_scans", 3), items)
    assert [item.t_ns for item in given] == [item.t_ns for item in items]
    pairs = [(a, b) for a, b in zip(items, given, strict=True) if isinstance(a, Scan) and isinstance(b, Scan)]
    other = [(a, b) for a, b in pairs if a is not b]
    assert 0.03 < len(other) / len(pairs) < 0.07
    mixed = [b for a, b in other if np.allclose(directions(a), directions(b), atol=1e-4)]
    elsewhere = [(a, b) for a, b in other if not any(b is one for one in mixed)]
    assert mixed
    assert elsewhere
    for a, b in elsewhere:
        source = next(s for s, _ in pairs if np.array_equal(s.points_m, b.points_m))
        assert a.t_ns - source.t_ns >= ELSEWHERE_NS


def test_mixed_points_keep_their_directions_and_the_ranges_as_a_set() -> None:
    variant = variant_of("outlier_scans", 0)
    given = [(a, b) for a in (scan(SECOND_NS + k) for k in range(100)) for b in variant.items(a) if a is not b]
    for before, after in given:
        assert isinstance(after, Scan)
        ranges = [np.sort(np.linalg.norm(one.points_m, axis=1)) for one in (before, after)]
        assert np.allclose(ranges[0], ranges[1], rtol=1e-4)
        assert not np.allclose(before.points_m, after.points_m)
    assert given


def test_without_deskewing_all_points_lie_in_the_middle_of_the_sweep() -> None:
    before = scan(SECOND_NS)
    (after,) = variant_of("no_deskew", 1).items(before)
    assert isinstance(after, Scan)
    assert after.t_ns == SECOND_NS + 49_500_000
    assert not after.t_offset_ns.any()
    assert np.array_equal(after.points_m, before.points_m)


@pytest.mark.parametrize("name", VARIANTS)
def test_an_empty_scan_passes(name: str) -> None:
    empty = Scan(SECOND_NS, np.zeros((0, 3), np.float32), np.zeros(0, np.uint32))
    assert [len(item) for item in variant_of(name, 1).items(empty) if isinstance(item, Scan)] == [0]


def directions(one: Scan) -> np.ndarray:
    return np.asarray(one.points_m / np.linalg.norm(one.points_m, axis=1, keepdims=True))
