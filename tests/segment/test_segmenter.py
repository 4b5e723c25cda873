"""Scans in, scans with marked movers out: what goes, what stays, and in which order and how late."""

from dataclasses import replace

import numpy as np
import pytest
from segment_scene import PARKED, SENSORS, Mover, scans

from gnd.vehicle_agent.localise.estimates import RefinedScan
from gnd.vehicle_agent.packed_rays import PlacedRays
from gnd.vehicle_agent.segment import MotionSegmenter, SegmentedScan, SegmentParameterError, SegmentParameters

NOISY = (0.04, 0.08)
CAR = (4.4, 1.8, 1.5)
ONCOMING = Mover(CAR, lambda t: (45.0 - 10.0 * t, 3.2))
AHEAD = Mover(CAR, lambda t: (14.0 + 6.5 * t, -1.7))  # keeps its distance from the vehicle, nearly
WALKER = Mover((0.5, 0.5, 1.75), lambda t: (16.0, 5.0 - 1.3 * t))
LORRY = Mover((10.0, 2.4, 3.5), lambda t: (28.0 - 5.0 * t, 3.4))


def segmented(
    labelled: list[tuple[RefinedScan, np.ndarray]], parameters: SegmentParameters | None = None
) -> list[tuple[SegmentedScan, np.ndarray]]:
    segmenter = MotionSegmenter(parameters)
    found = [done for scan, _ in labelled for done in segmenter.push(scan)] + list(segmenter.flush())
    assert [s.scan.t_ns for s in found] == [scan.t_ns for scan, _ in labelled]
    return [(s, moves) for s, (_, moves) in zip(found, labelled, strict=True)]


def shares(found: list[tuple[SegmentedScan, np.ndarray]], far_m: float = 40.0) -> tuple[float, float]:
    """Share of mover points that are left, share of standing points that are lost."""
    counts = np.zeros(4)
    for s, moves in found:
        r = np.linalg.norm(s.scan.points_map_m - s.scan.origins_map_m, axis=1)
        near = (r > 2.0) & (r < far_m)
        gone = s.moving[near]
        m = moves[near]
        counts += [(m & ~gone).sum(), m.sum(), (~m & gone).sum(), (~m).sum()]
    assert counts[1] > 300
    return counts[0] / counts[1], counts[2] / counts[3]


@pytest.mark.parametrize(("sensor", "noise"), [("16 layers", (0.0, 0.0)), ("16 layers", NOISY), ("32 layers", NOISY)])
def test_movers_go_and_what_stands_stays(sensor: str, noise: tuple[float, float]) -> None:
    found = segmented(list(scans(SENSORS[sensor], (ONCOMING, AHEAD, WALKER), noise=noise)))
    left, lost = shares(found)
    assert left < 0.06
    assert lost < 0.003


def test_four_layers_at_the_bumper_find_cars_too() -> None:
    found = segmented(list(scans(SENSORS["4 layers ahead"], (ONCOMING, AHEAD), noise=NOISY)))
    left, lost = shares(found)
    assert left < 0.2
    assert lost < 0.01


def test_nothing_moves_where_all_stand_and_the_parked_car_is_kept() -> None:
    for noise in ((0.0, 0.0), NOISY):
        labelled = list(scans(SENSORS["16 layers"], (), noise=noise))
        found = segmented(labelled)
        assert np.mean([s.moving.mean() for s, _ in found]) < 0.002
        lost, seen = 0, 0
        for s, _ in found:
            p = s.scan.points_map_m
            on_car = (p[:, :2] > np.array(PARKED[:2]) - 0.2).all(axis=1) & (p[:, :2] < np.array(PARKED[2:4]) + 0.2).all(
                axis=1
            )
            on_car &= p[:, 2] > 0.3
            lost, seen = lost + int((s.moving & on_car).sum()), seen + int(on_car.sum())
        assert seen > 1000
        assert lost < 0.01 * seen


def test_the_side_of_a_lorry_goes_with_its_ends() -> None:
    """For a second the lorry covers much of its own side."""
    found = segmented(list(scans(SENSORS["32 layers"], (LORRY,), noise=NOISY)))
    left, _ = shares(found[12:-12])
    assert left < 0.08


def test_a_standing_vehicle_sees_movers_as_well() -> None:
    """Its rings of ground are far apart: what stands low between them may be taken for ground."""
    left, lost = shares(segmented(list(scans(SENSORS["16 layers"], (ONCOMING, WALKER), speed_mps=0.0, noise=NOISY))))
    assert left < 0.25
    assert lost < 0.002


def test_scans_come_back_whole_and_no_later_than_the_lag() -> None:
    labelled = list(scans(SENSORS["16 layers"], (ONCOMING,), seconds=2.5))
    segmenter, newest = MotionSegmenter(), {}
    for scan, _ in labelled:
        for done in segmenter.push(scan):
            newest[done.scan.t_ns] = scan.t_ns
    lags_s = np.array([1e-9 * (b - a) for a, b in newest.items()])
    assert len(newest) == len(labelled) - 12
    assert (abs(lags_s - segmenter.parameters.future_s) < 0.101).all()
    for (scan, _), (back, _) in zip(labelled, segmented(labelled), strict=True):
        np.testing.assert_allclose(back.scan.points_map_m, scan.points_map_m, atol=2e-5)
        np.testing.assert_allclose(back.scan.origins_map_m, scan.origins_map_m, atol=1e-4)
        assert back.scan.estimate is scan.estimate
        assert back.moving.shape == (len(scan.points_map_m),)


def test_switched_off_every_scan_comes_back_at_once_and_nothing_moves() -> None:
    segmenter = MotionSegmenter(SegmentParameters(enabled=False))
    for scan, _ in scans(SENSORS["16 layers"], (ONCOMING,), seconds=0.5):
        (done,) = segmenter.push(scan)
        assert done.scan is scan
        assert not done.moving.any()
    assert list(segmenter.flush()) == []


def moved_up(rays: PlacedRays) -> PlacedRays:
    return rays._replace(ends_m=rays.ends_m + 3.0)


def test_scans_with_poor_poses_are_not_judged_and_judge_nobody() -> None:
    labelled = list(scans(SENSORS["16 layers"], (ONCOMING, WALKER), noise=NOISY))
    wrong = [
        (
            replace(scan, rays=moved_up(scan.rays), estimate=replace(scan.estimate, health="degraded")),
            moves,
        )
        if k % 4 == 1
        else (scan, moves)
        for k, (scan, moves) in enumerate(labelled)
    ]
    found = segmented(wrong)
    assert not any(s.moving.any() for s, _ in found[1::4])
    left, lost = shares([pair for k, pair in enumerate(found) if k % 4 != 1])
    assert left < 0.08
    assert lost < 0.003


def test_an_empty_scan_and_a_pause_pass_through() -> None:
    labelled = list(scans(SENSORS["16 layers"], (ONCOMING,), seconds=1.0))
    none = np.zeros((0, 3))
    empty = replace(labelled[5][0], rays=PlacedRays(none, none))
    later = [replace(scan, t_ns=scan.t_ns + 60_000_000_000) for scan, _ in labelled]
    order = [scan for scan, _ in labelled[:5]] + [empty] + later
    segmenter = MotionSegmenter()
    found = [done for scan in order for done in segmenter.push(scan)] + list(segmenter.flush())
    assert [len(s.moving) for s in found] == [len(s.points_map_m) for s in order]


def test_what_waits_takes_less_than_two_fifths_of_the_memory() -> None:
    segmenter = MotionSegmenter()
    labelled = list(scans(SENSORS["16 layers"], (ONCOMING,), seconds=1.2))
    for scan, _ in labelled:
        assert segmenter.push(scan) == []
    held = sum(
        array.nbytes
        for h in segmenter._held
        for array in (h.rays.points_m, h.rays.starts, h.rays.until, h.objects.voxel_of)  # type: ignore[union-attr]
    )
    came = sum(scan.points_map_m.nbytes + scan.origins_map_m.nbytes for scan, _ in labelled)
    assert held < 0.4 * came


@pytest.mark.parametrize("bad", [{"future_s": -1.0}, {"future_s": 101.0}, {"range_max_m": 1.0}, {"range_max_m": 301.0}])
def test_parameters_that_cannot_work_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(SegmentParameterError, match=next(iter(bad))):
        SegmentParameters(**bad)  # type: ignore[arg-type]


@pytest.mark.parametrize(("size_m", "ahead_m"), [((4.8, 2.0, 2.1), 15.0), ((12.0, 2.5, 3.5), 22.0)])
def test_who_drives_ahead_at_the_same_speed_is_found_by_later_scans(
    size_m: tuple[float, float, float], ahead_m: float
) -> None:
    """A van, a lorry: they cover their own place in all earlier scans; later ones look through where they were."""
    leader = Mover(size_m, lambda t: (ahead_m + 6.0 * t, 0.0))
    left, lost = shares(segmented(list(scans(SENSORS["32 layers"], (leader,), speed_mps=6.0, noise=NOISY)))[:-12])
    assert left < 0.02
    assert lost < 0.003


def test_who_drives_ahead_is_kept_when_nobody_looks_later() -> None:
    """The past alone knows nothing of its place: without future scans the leader stays, and that is what is said."""
    leader = Mover((4.8, 2.0, 2.1), lambda t: (15.0 + 6.0 * t, 0.0))
    found = segmented(list(scans(SENSORS["32 layers"], (leader,), speed_mps=6.0)), SegmentParameters(future_s=0.0))
    assert shares(found)[0] > 0.5
