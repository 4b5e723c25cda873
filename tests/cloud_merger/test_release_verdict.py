"""The verdict on a version on trial, with known truth: its rate of false alarms, its power, what one vehicle can do."""

import numpy as np
import pytest

from gnd.cloud_merger.release.verdict import (
    ENOUGH,
    FALSE_ALARM,
    LOOKS,
    SILENT_S,
    LooksTaken,
    judged,
    level_of_a_look,
    score_of,
)
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.trials import Arm, VehicleHealth, VersionTrial

HOUR_NS = 3_600_000_000_000
START_NS = 1_800_000_000_000_000_000
TRIAL = VersionTrial("ndt", TileId(497353963154), 2, 1, 0.1, 24 * HOUR_NS, START_NS, "trial")
NO_LOOKS = LooksTaken()
SOON, OVER = START_NS + HOUR_NS, START_NS + 25 * HOUR_NS


def car(number: int, arm: Arm, fit: float = 0.8, **said) -> VehicleHealth:
    usual = {"scans": 20, "matched": 900, "fit": round(1000 * fit), "elsewhere": 800, "inside": 15}
    rest = {"gated": 0, "not_good": 0, "has_left": True, "first_ns": START_NS, "t_ns": START_NS}
    return VehicleHealth(vehicle=f"{arm}-{number}", arm=arm, **{**usual, **rest, **said})


def cars(arm: Arm, fits) -> list[VehicleHealth]:
    return [car(k, arm, fit) for k, fit in enumerate(fits)]


def silent(arm: Arm, n: int) -> list[VehicleHealth]:
    nothing = {"scans": 0, "matched": 0, "elsewhere": 0, "inside": 0, "has_left": False}
    return [car(1000 + k, arm, 0.0, **nothing) for k in range(n)]


def spread(n: int, mean: float = 0.8, sd: float = 0.03, seed: int = 1) -> list[float]:
    return np.random.default_rng(seed).normal(mean, sd, n).tolist()


def verdict(said, now_ns=SOON, before=NO_LOOKS):
    return judged(TRIAL, said, now_ns, before)


def test_a_version_on_which_vehicles_fare_as_before_is_released_once_enough_have_spoken():
    few = cars("new", spread(ENOUGH - 1)) + cars("old", spread(40, seed=2))
    assert verdict(few).decision == "wait"
    assert verdict([*few, car(99, "new")]).decision == "release"


def test_a_version_on_which_four_fare_worse_than_all_others_is_withdrawn():
    found = verdict(cars("new", [0.5, 0.52, 0.48, 0.51]) + cars("old", spread(LOOKS[0][1])))
    assert found.decision == "withdraw"
    assert found.looks.p_worse <= level_of_a_look()
    assert "4 vehicles fare worse" in found.why


def test_a_look_is_taken_once():
    told = cars("new", [0.5, 0.52, 0.48, 0.9]) + cars("old", spread(20))
    found = verdict(told)
    assert (found.decision, found.looks.worse) == ("wait", 1)
    worse_now = cars("new", [0.5, 0.52, 0.48, 0.49]) + cars("old", spread(20))
    assert verdict(worse_now, before=found.looks).looks == found.looks


def test_harm_within_the_margin_is_no_reason():
    found = verdict(cars("new", [0.79] * 28) + cars("old", [0.8] * 64))
    assert found.decision == "release"


@pytest.mark.parametrize("sd", [0.01, 0.3])
def test_harmless_versions_are_withdrawn_no_oftener_than_the_rate_says(sd):
    """The whole sequence of looks, over vehicles that differ much or little; the vehicle that speaks next is of the new
    version with the chance of the share. A margin of zero stands for the worst case: harm exactly at the margin.
    """
    rng, withdrawn, runs = np.random.default_rng(7), 0, 100
    for _ in range(runs):
        scores = rng.normal(0.7, sd, 100)
        is_new = rng.random(100) < 0.2
        looks, told = LooksTaken(), list[VehicleHealth]()
        for k, (score, new) in enumerate(zip(scores, is_new, strict=True)):
            lower = 0.02 if new else 0.0  # exactly as much worse as does not matter yet
            told.append(car(k, "new" if new else "old", min(max(score - lower, 0.0), 1.0)))
            if k % 3:
                continue
            found = verdict(told, before=looks)
            looks = found.looks
            if found.decision == "withdraw":
                withdrawn += 1
                break
    assert withdrawn <= max(3 * FALSE_ALARM * runs, 1)  # 1 is expected at most


def test_one_vehicle_alone_neither_withdraws_nor_releases():
    old = cars("old", spread(40, seed=3))
    liar = [car(500, "new", 0.0, gated=15, not_good=15)]
    for honest in range(1, 20):
        assert verdict(cars("new", spread(honest, seed=honest)) + liar + old).decision != "withdraw"
    flatterer = [car(501, "new", 1.0)]
    assert verdict(cars("new", [0.5, 0.49, 0.51]) + flatterer + old).decision == "wait"
    assert verdict(cars("new", [0.7] * (ENOUGH - 1)) + flatterer + old).decision != "release"


def test_one_liar_on_the_old_version_hides_no_harm():
    old = [*spread(30, seed=4), 0.0]
    assert verdict(cars("new", [0.5, 0.52, 0.48, 0.51, 0.5, 0.49]) + cars("old", old)).decision == "withdraw"


def test_vehicles_that_fall_silent_on_a_version_withdraw_it():
    now = START_NS + round((SILENT_S + 1) * 1e9)
    found = verdict([*silent("new", 6), *cars("old", spread(30))], now)
    assert (found.decision, found.new.silent) == ("withdraw", 6)
    early = verdict([*silent("new", 6), *cars("old", spread(30))], START_NS + 10**9)
    assert early.decision == "wait"


def test_one_silent_vehicle_and_silence_on_both_versions_withdraw_nothing():
    now = START_NS + round((SILENT_S + 1) * 1e9)
    assert verdict([*silent("new", 1), *cars("new", spread(8)), *cars("old", spread(30))], now).decision == "release"
    both = [*silent("new", 10), *silent("old", 40), *cars("new", spread(9)), *cars("old", spread(30))]
    assert verdict(both, now).decision == "release"


def test_who_has_left_without_having_seen_the_tile_is_not_silent():
    gone = [car(k, "new", 0.0, scans=0, matched=0, elsewhere=0, inside=0) for k in range(8)]
    found = verdict([*gone, *cars("old", spread(30))], SOON)
    assert (found.new.silent, found.new.told, found.decision) == (0, 0, "wait")


def test_where_nobody_drove_a_version_is_released_when_its_time_is_over():
    assert verdict([], OVER).decision == "release"
    assert verdict(cars("new", [0.4, 0.4]) + cars("old", spread(3)), OVER).decision == "release"


def test_what_seems_worse_and_may_be_chance_waits_for_somebody_even_when_its_time_is_over():
    found = verdict(cars("new", [0.6, 0.62, 0.61, 0.6]) + cars("old", spread(5)), OVER)
    assert found.decision == "wait"
    assert "may be chance" in found.why


def test_a_vehicle_that_is_lost_in_the_tile_fares_worst():
    lost = car(1, "new", 0.0, scans=0, matched=0, elsewhere=0, inside=12, gated=12, not_good=12)
    half = car(2, "new", 0.8, inside=10, not_good=5)
    fine = car(3, "new", 0.8)
    assert score_of(lost) == -1.0
    assert score_of(half) == pytest.approx(-0.5)
    assert score_of(fine) == 0.0
    assert score_of(car(4, "new", scans=2, inside=2)) is None
