"""Buckets of vehicles, on a clock of the test: what is admitted, what is told to wait; memory stays bounded."""

import pytest

from gnd.cloud_merger import admission
from gnd.cloud_merger.admission import Admission, TokenBucket
from gnd.cloud_merger.metrics import ShardMetrics
from gnd.cloud_merger.served import (
    CPU_S_A_MINUTE,
    CPU_S_AT_ONCE,
    NEW_CPU_S_A_MINUTE,
    NEW_CPU_S_AT_ONCE,
    ServedCpu,
)
from gnd.fleet_bus.errors import Busy
from gnd.schemas.upload_head import UploadHead
from gnd.tile_store.uploads import FirstHalf


class Clock:
    now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


class Waiting:
    """So many wait."""

    def __init__(self) -> None:
        self.of_vehicle, self.of_all, self.halves = 0, 0, []

    def uploads_waiting(self, vehicle, at_most):
        return min(at_most, self.of_all if vehicle is None else self.of_vehicle)

    def first_halves(self, _key, _report_id):
        return self.halves


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def store():
    return Waiting()


@pytest.fixture
def desk(store, clock):
    return Admission(store, 60.0, clock_s=clock)


def head(vehicle="car", form="packed") -> UploadHead:
    return UploadHead(form, "01HF7YAT00G64BYCG4N0QWA5PP", vehicle)


def admitted(desk, vehicle, n, size=100) -> int:
    for k in range(n):
        try:
            desk.admit("key", head(vehicle), size)
        except Busy:
            return k
    return n


def test_a_bucket_gives_what_it_holds_and_fills_steadily():
    bucket = TokenBucket(60.0, 10.0, 0.0)
    for _ in range(10):
        assert bucket.missing_s(1, 0.0) == 0.0
        bucket.take(1)
    assert bucket.missing_s(1, 0.0) == pytest.approx(1.0)
    assert bucket.missing_s(1, 1.0) == 0.0
    assert TokenBucket(60.0, 10.0, 0.0).missing_s(50, 0.0) == 0.0, "more than it holds, when it is full"


def test_a_vehicle_sends_so_many_at_once_then_so_many_a_minute(desk, clock):
    assert admitted(desk, "car", 1000) == admission.NEWCOMER_REPORTS
    with pytest.raises(Busy) as told:
        desk.admit("key", head("car"), 100)
    assert told.value.retry_after_s == pytest.approx(1.0)
    assert told.value.reason == "reports"
    assert admitted(desk, "other", 10) == 10, "another vehicle is not told to wait"
    clock.now_s += 3600.0
    assert admitted(desk, "car", 1000) == admission.REPORTS_AT_ONCE


def test_bytes_are_counted_apart(desk):
    assert admitted(desk, "car", 100, size=8 * admission.MIB) == 8


def test_new_names_share_a_bucket_and_known_ones_do_not_feel_it(desk, clock):
    assert admitted(desk, "car", 1) == 1
    taken = sum(admitted(desk, f"invented-{n}", 1) for n in range(3 * admission.NAMES_AT_ONCE))
    assert taken == admission.NAMES_AT_ONCE - 1
    assert admitted(desk, "car", 10) == 10
    assert len(desk) <= admission.NAMES_AT_ONCE


def test_while_known_vehicles_come_few_names_are_let_in_at_once_and_who_comes_again_is(desk, clock):
    def invented(start: int, n: int) -> int:
        return sum(admitted(desk, f"invented-{start + k}", 1) for k in range(n))

    admitted(desk, "car", 1)
    clock.now_s += admission.KNOWN_AFTER_S
    admitted(desk, "car", 1)  # known from now on
    assert invented(0, 1000) == admission.FIRST_NAMES_AT_ONCE
    clock.now_s += 60.0
    admitted(desk, "car", 1)
    taken = 0
    for second in range(60):  # 200 other names a second, and one that obeys
        taken += invented(10_000 + 200 * second, 200)
        if second == 10:
            with pytest.raises(Busy, match="more than 60 new vehicles a minute") as told:
                desk.admit("key", head("newcomer"), 100)
            assert (told.value.retry_after_s, told.value.reason) == (admission.WAITING_RETRY_S, "names")
        if second == 14:
            assert admitted(desk, "newcomer", 1) == 0, "before its time"
        if second == 15:
            assert admitted(desk, "newcomer", 1) == 1
        clock.now_s += 1.0
        admitted(desk, "car", 1)
    assert taken <= admission.FIRST_NAMES_AT_ONCE + 60
    assert admitted(desk, "newcomer", 10) == 10
    before = len(desk)
    for second in range(60):  # and names that all obey: so many a minute
        invented(100_000 + 200 * (second % 6), 200)
        clock.now_s += 1.0
        admitted(desk, "car", 1)
    assert len(desk) - before <= admission.AGAIN_AT_ONCE + admission.AGAIN_A_MINUTE + admission.FIRST_NAMES_AT_ONCE + 60
    clock.now_s += admission.FIRST_COME_S
    assert invented(200_000, 1000) == admission.NAMES_AT_ONCE, "nobody who is known comes: as after a start"


def test_names_that_certificates_tell_are_let_in_at_once(store, clock):
    desk = Admission(store, 60.0, names_cost=True, clock_s=clock)
    admitted(desk, "car", 1)
    clock.now_s += admission.KNOWN_AFTER_S
    admitted(desk, "car", 1)
    assert sum(admitted(desk, f"vehicle-{n}", 1) for n in range(1000)) == admission.NAMES_AT_ONCE


def test_memory_is_bounded_whatever_names_are_invented(desk, clock, monkeypatch):
    monkeypatch.setattr(admission, "REMEMBERED_NAMES", 50)
    for n in range(300):
        clock.now_s += 1.0
        admitted(desk, f"invented-{n}", 1)
        admitted(desk, "car", 1)
    for n in range(300):
        admitted(desk, f"at-once-{n}", 1)
    assert len(desk) == 50
    assert len(desk._asked_s) == 50
    assert "car" in desk._accounts


def test_what_waits_is_bounded_for_a_vehicle_and_for_all(desk, store, clock):
    store.of_vehicle = admission.WAITING_OF_VEHICLE
    with pytest.raises(Busy, match=r"256 uploads of car wait"):
        desk.admit("key", head(), 100)
    store.of_vehicle, store.of_all = 0, admission.WAITING_OF_ALL // 2
    clock.now_s += 1.0
    with pytest.raises(Busy, match="10000 uploads wait"):
        desk.admit("key", head(), 100)
    clock.now_s += admission.KNOWN_AFTER_S
    desk.admit("key", head(), 100)  # a name that is known has the other half


def test_gaussians_are_the_vehicles_whose_flags_have_come(desk, store):
    store.halves = [FirstHalf(1, "car", "wanted", b"", "", b"")]
    for _ in range(admission.NEWCOMER_REPORTS):
        desk.admit("key", head("", "gaussians"), 100)
    assert admitted(desk, "car", 1) == 0
    store.halves = []
    desk.admit("key", head("", "gaussians"), 100)


def test_an_owner_has_a_bucket_of_its_own(store, clock, monkeypatch):
    monkeypatch.setattr(admission, "OWNER_VEHICLES", 1)
    desk = Admission(store, 60.0, owner_of=lambda vehicle: vehicle.partition("-")[0], clock_s=clock)
    assert sum(admitted(desk, f"acme-{n}", 100) for n in range(10)) == admission.REPORTS_AT_ONCE
    assert admitted(desk, "other-1", 5) == 5


def test_nonsense_is_kept_so_often_only(desk):
    for _ in range(admission.NONSENSE_AT_ONCE):
        desk.admit_nonsense()
    with pytest.raises(Busy, match="cannot be read"):
        desk.admit_nonsense()


def test_who_has_had_least_comes_first_and_invented_names_do_not(clock):
    served = ServedCpu(clock)
    for name in ("little", "much"):
        served.spent(name, 0.0)
    clock.now_s += 40.0
    served.spent("little", 0.1)
    served.spent("much", 5.0)
    for n in range(100):
        served.spent(f"invented-{n}", 0.01)
    assert served.in_turn(["much", "new", "little"]) == ["little", "much", "new"]
    clock.now_s += 3600.0
    served.spent("little", 1.0)
    assert served.in_turn(["much", "new", "little"]) == ["new", "much", "little"], "what was spent fades"


def test_of_names_that_are_new_one_comes_after_three_that_are_known(clock):
    served = ServedCpu(clock)
    known = [f"known-{n}" for n in range(6)]
    served.in_turn(known)
    clock.now_s += 31.0
    served.in_turn(known)
    turns = served.in_turn([*(f"new-{n}" for n in range(50)), *known])
    assert [name.startswith("new") for name in turns[:9]] == [False, False, False, True] * 2 + [True]
    assert sorted(turns) == sorted([*(f"new-{n}" for n in range(50)), *known])


def known_ones(served, clock, *names) -> None:
    served.in_turn(names)
    clock.now_s += 31.0
    served.in_turn(names)


def test_who_used_more_cpu_than_a_vehicle_may_waits_until_its_bucket_has_filled(clock):
    served = ServedCpu(clock)
    known_ones(served, clock, "dear", "cheap")
    for _ in range(round(2 * CPU_S_AT_ONCE)):
        served.spent("dear", 1.0)
    assert served.in_turn(["dear", "cheap"]) == ["cheap"]
    assert served.held_back == 1
    clock.now_s += 60.0 * (CPU_S_AT_ONCE / CPU_S_A_MINUTE) - 2.0
    assert served.in_turn(["dear", "cheap"]) == ["cheap"]
    clock.now_s += 4.0
    assert set(served.in_turn(["dear", "cheap"])) == {"dear", "cheap"}
    assert served.held_back == 0


def test_what_invented_names_cost_a_minute_is_bounded_while_known_vehicles_come(clock):
    served = ServedCpu(clock)
    known_ones(served, clock, "known")
    spent_s, cost_s = 0.0, 0.05
    for n in range(60_000):  # ten minutes, ten looks a second
        turns = served.in_turn(["known", f"invented-{n}"])
        assert "known" in turns
        if len(turns) == 2:
            served.spent(turns[1], cost_s)
            spent_s += cost_s
        clock.now_s += 0.01
    assert spent_s <= 10 * NEW_CPU_S_A_MINUTE + NEW_CPU_S_AT_ONCE + cost_s
    assert spent_s >= 10 * NEW_CPU_S_A_MINUTE


def test_where_all_are_new_nobody_waits_for_the_share_of_newcomers(clock):
    served = ServedCpu(clock)
    for n in range(100):
        served.spent(f"new-{n}", 1.0)
    assert len(served.in_turn([f"new-{n}" for n in range(100)])) == 100


def test_newcomers_are_patient_while_known_vehicles_come(desk, clock):
    assert desk.admit("key", head("car"), 100) == 0.0, "all are new"
    clock.now_s += 31.0
    assert desk.admit("key", head("car"), 100) == 0.0
    assert desk.admit("key", head("new"), 100) == admission.PATIENT_S
    clock.now_s += 11.0
    assert desk.admit("key", head("newer"), 100) == 0.0, "nobody else sends"


def test_metrics_show_what_was_spent_and_who_waits(clock):
    served, metrics = ServedCpu(clock), ShardMetrics()
    metrics.show_served(served)
    known_ones(served, clock, "dear")
    for _ in range(100):
        served.spent("dear", 1.0)
    served.spent("new", 2.0)
    served.in_turn(["dear", "new"])
    shown = {(one.name, one.labels.get("whose")): one.value for m in metrics.registry.collect() for one in m.samples}
    assert shown["gnd_vehicles_held_back", None] == 1
    assert shown["gnd_upload_cpu_seconds", "known"] == 100.0
    assert shown["gnd_upload_cpu_seconds", "new"] == 2.0
