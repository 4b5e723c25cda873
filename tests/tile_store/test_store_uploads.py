"""Uploads: kept once as they came, leased by a clock that cannot step, settled all or not at all."""

import re
import subprocess
import sys
import threading
from dataclasses import replace
from importlib.util import find_spec

import pytest
from store_helpers import TILE, Clock, Maker, of_a_file, report, report_id

from gnd.tile_store import clocks, sql_uploads
from gnd.tile_store.errors import IdTaken, StoreError
from gnd.tile_store.sqlite_connection import SQL
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.store import Store
from gnd.tile_store.uploads import Answered, Settled, Upload, UploadClaim

KEY = "gnd/v1/change/ndt/13033/03021/23031"
SECOND = 1_000_000_000


class Machine:
    """The machine's clock of leases; `restart` is a reboot."""

    def __init__(self) -> None:
        self.now, self.name = 1000 * SECOND, "first"

    def restart(self) -> None:
        self.now, self.name = 5 * SECOND, "second"


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    machine = Machine()
    monkeypatch.setattr(clocks, "steady_ns", lambda: machine.now)
    monkeypatch.setattr(clocks, "boot_id", lambda: machine.name)
    if find_spec("psycopg"):
        monkeypatch.setattr("gnd.tile_store.postgres_connection.DatabaseClock.steady_ns", lambda _: machine.now)
    return machine


def flags(number: int = 1, body: bytes = b"flags", vehicle: str = "v1") -> Upload:
    return Upload(KEY, body + bytes([number]), report_id(number), vehicle, "packed", 77)


def gaussians(number: int = 1) -> Upload:
    return Upload(KEY, b"gaussians" + bytes([number]), report_id(number), "", "gaussians", 78)


def claimed(store: Store, owner: str = "a", n: int = 8, lease_s: float = 10.0) -> list[UploadClaim]:
    return store.claim_uploads(owner, n, lease_s)


def numbers(claims: list[UploadClaim]) -> list[bytes]:
    return [claim.upload.body[-1:] for claim in claims]


@pytest.mark.parametrize("name", ["consume_reports", "still_dirty", "move_waiting"])
@of_a_file
def test_what_is_done_to_reports_that_wait_does_not_look_at_those_that_are_merged(store, name):
    """Under the write lock, for which acknowledgements wait: a tile may have thousands of reports. PostgreSQL plans by
    what is there, and takes no hints.
    """
    statement = SQL[name]
    values = dict.fromkeys(re.findall(r":(\w+)", statement), 1)
    plan = store.look(lambda c: [row[3] for row in c.execute("EXPLAIN QUERY PLAN " + statement, values)])
    of_reports = [line for line in plan if "report" in line]
    assert of_reports
    assert all("INDEX report_waiting" in line for line in of_reports), plan


def test_the_same_bytes_on_the_same_key_are_kept_once(store: Store) -> None:
    assert store.put_upload(flags(), "a") == "stored"
    assert store.put_upload(replace(flags(), received_ns=99), "b") == "duplicate"
    assert store.put_upload(replace(flags(), key=KEY + "x"), "a") == "stored"
    assert store.put_upload(flags(body=b"other"), "a") == "stored", "the same id says nothing"
    assert store.upload_counts().by_state == {"waiting": 3}


def test_a_claim_is_the_upload_as_it_came_and_is_given_once(store: Store) -> None:
    store.put_upload(flags(), "a")
    (claim,) = claimed(store)
    assert (claim.upload, claim.owner, claim.attempts) == (flags(), "a", 1)
    assert claimed(store) == []
    assert claimed(store, "b") == []


def test_who_received_an_upload_has_a_second_before_others(store: Store, machine: Machine) -> None:
    store.put_upload(flags(), "a")
    machine.now += SECOND - 1
    assert claimed(store, "b") == []
    machine.now += 1
    assert len(claimed(store, "b")) == 1


def test_who_has_uploads_of_its_own_helps_where_others_lag_twice_as_far(store: Store, machine: Machine) -> None:
    store.put_upload(flags(1), "b")
    machine.now += 2 * SECOND
    store.put_upload(flags(2, vehicle="v2"), "a")
    machine.now += 2 * SECOND
    assert numbers(claimed(store)) == [b"\2"], "4 s are less than 1 + 2 * 2"
    store.put_upload(flags(3, vehicle="v2"), "a")
    machine.now += SECOND
    assert numbers(claimed(store)) == [b"\1", b"\3"], "5 s are more than 1 + 2 * 1"


def test_where_very_much_waits_own_uploads_come_first_all_the_same(
    store: Store, machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gnd.tile_store.sql_uploads.MOST_OWN", 2)
    store.put_upload(flags(1), "b")
    machine.now += SECOND
    for number in (2, 3, 4):
        store.put_upload(flags(number, vehicle=f"v{number}"), "a")
    machine.now += SECOND
    assert numbers(claimed(store)) == [b"\2", b"\3", b"\4"]
    assert numbers(claimed(store)) == [b"\1"], "it has none of its own any more"


def test_who_has_none_of_its_own_helps(store: Store, machine: Machine) -> None:
    store.put_upload(flags(1), "b")
    assert claimed(store) == []
    machine.now += SECOND
    assert numbers(claimed(store)) == [b"\1"]


def test_a_lease_ends_by_the_clock_of_the_machine_and_not_by_the_date(
    store: Store, machine: Machine, clock: Clock
) -> None:
    store.put_upload(flags(), "a")
    claimed(store, lease_s=10.0)
    clock.advance(86_400)
    assert claimed(store, "b") == []
    clock.advance(-2 * 86_400)
    machine.now += 10 * SECOND
    (again,) = claimed(store, "b")
    assert again.attempts == 2


@of_a_file
def test_a_lease_of_before_the_machine_was_started_has_ended(store: Store, machine: Machine) -> None:
    store.put_upload(flags(), "a")
    claimed(store, lease_s=3000.0)
    machine.restart()
    assert len(claimed(store, "b")) == 1


def test_a_lease_that_no_such_clock_has_written_has_ended(store: Store, machine: Machine) -> None:
    """Another system without names of its starts."""
    store.put_upload(flags(), "a")
    machine.now = 10**9 * SECOND
    claimed(store, lease_s=10.0)
    machine.now = 5 * SECOND
    assert len(claimed(store, "b")) == 1


def test_the_leases_of_who_has_died_are_freed_and_what_it_received_goes_to_others(
    store: Store, machine: Machine
) -> None:
    for number in (1, 2):
        store.put_upload(flags(number), "a")
    claimed(store, n=1)
    store.release("a")
    assert numbers(claimed(store, "b")) == [b"\x01"], "claimed before: alone"
    assert numbers(claimed(store, "b")) == [b"\x02"]


def test_those_that_were_never_claimed_come_first_and_those_that_were_come_alone(
    store: Store, machine: Machine
) -> None:
    for number in (1, 2, 3):
        store.put_upload(flags(number), "a")
    assert len(claimed(store)) == 3
    machine.now += 11 * SECOND
    store.put_upload(flags(4), "a")
    assert [numbers(claimed(store)) for _ in range(5)] == [[b"\x01"], [b"\x02"], [b"\x03"], [b"\x04"], []]
    machine.now += 11 * SECOND
    assert [numbers(claimed(store)) for _ in range(4)] == [[b"\x04"], [b"\x01"], [b"\x02"], [b"\x03"]], "fewest first"


def test_an_upload_that_was_given_back_waits(store: Store, machine: Machine) -> None:
    store.put_upload(flags(), "a")
    store.postpone_upload(claimed(store)[0], 2.0)
    assert claimed(store) == []
    machine.now += 2 * SECOND
    again = claimed(store)[0]
    assert again.attempts == 2
    store.postpone_upload(again, 2.0, blameless=True)
    assert claimed(store) == [], "it waits, too"
    machine.now += 2 * SECOND
    assert claimed(store)[0].attempts == 2


def test_rows_state_and_mask_are_written_together(store: Store) -> None:
    store.put_upload(flags(), "a")
    (claim,) = claimed(store)
    assert store.settle_upload(Settled(claim, "wanted", (report(1),), b"mask"))
    assert [row.report_id for row in store.reports()] == [report_id(1)]
    (status,) = store.upload_statuses("v1", [report_id(1), report_id(2)])
    assert (status.report_id, status.state, status.wanted) == (report_id(1), "wanted", b"mask")
    (half,) = store.first_halves(KEY, report_id(1))
    assert (half.state, half.wanted, half.journal_id, half.body) == ("wanted", b"mask", report_id(1), flags().body)
    assert store.first_parts("ndt", report_id(1), [TILE]) == [report(1)]
    assert store.dirty_count() == 1


def test_who_has_lost_the_lease_changes_nothing(store: Store, machine: Machine) -> None:
    store.put_upload(flags(), "a")
    (late,) = claimed(store, "a")
    machine.now += 11 * SECOND
    (now,) = claimed(store, "b")
    assert not store.settle_upload(Settled(late, "released", (report(1),)))
    assert store.counts().report_rows == 0
    assert store.settle_upload(Settled(now, "released", (report(1),)))
    assert not store.settle_upload(Settled(now, "quarantined", reason="twice"))
    assert store.quarantined() == []


def test_a_row_of_another_vehicle_undoes_all(store: Store) -> None:
    store.put_reports([report(1, vehicle="v2")])
    taken = replace(report(1), report_id=report(1, vehicle="v2").report_id)
    store.put_upload(flags(), "a")
    (claim,) = claimed(store)
    with pytest.raises(IdTaken, match="its id is one of v2"):
        store.settle_upload(Settled(claim, "released", (report(9), taken)))
    assert store.counts().report_rows == 1
    assert store.settle_upload(Settled(claim, "released", (report(9),)))


def test_gaussians_wait_for_their_flags_without_being_looked_at_again(store: Store, machine: Machine) -> None:
    store.put_upload(gaussians(), "a")
    (claim,) = claimed(store)
    assert store.settle_upload(Settled(claim, "early"))
    machine.now += 3000 * SECOND
    assert claimed(store) == []
    store.put_upload(flags(), "a")
    (first,) = claimed(store)
    assert store.settle_upload(Settled(first, "wanted", (report(1),), b"mask"))
    (again,) = claimed(store)
    assert (again.upload, again.attempts) == (gaussians(), 1)
    assert store.upload_statuses("v1", [report_id(1)])[0].state == "waiting", "its Gaussians are being looked at"


def test_gaussians_do_not_wait_for_flags_that_were_settled_meanwhile(store: Store) -> None:
    store.put_upload(gaussians(), "a")
    store.put_upload(flags(), "a")
    early, first = claimed(store)
    assert store.settle_upload(Settled(first, "wanted", (report(1),), b"mask"))
    assert not store.settle_upload(Settled(early, "early"))
    store.postpone_upload(early, 0.0)
    (again,) = claimed(store)
    answered = Answered(first.number, "released")
    assert store.settle_upload(Settled(again, "released", (replace(report(1), part=1),), first=answered))
    assert store.upload_statuses("v1", [report_id(1)])[0].state == "released"


def test_refused_bytes_are_in_quarantine_and_out_of_the_uploads(store: Store) -> None:
    store.put_upload(flags(), "a")
    (claim,) = claimed(store)
    store.settle_upload(Settled(claim, "quarantined", reason="because of 7"))
    (kept,) = store.quarantined()
    assert (kept.body, kept.reason, kept.source) == (flags().body, "because of 7", KEY)
    assert store.put_upload(flags(), "a") == "duplicate"


def test_what_is_settled_may_be_forgotten_and_what_waits_never_is(store: Store) -> None:
    for number in (1, 2):
        store.put_upload(flags(number), "a")
    (claim,) = claimed(store, n=1)
    store.settle_upload(Settled(claim, "released", (report(1),)))
    assert (store.forget_uploads(77), store.forget_uploads(78)) == (0, 1)
    assert store.upload_counts().by_state == {"waiting": 1}
    assert store.counts().report_rows == 1


def test_many_threads_claim_each_upload_once(store: Store) -> None:
    for number in range(60):
        store.put_upload(flags(number), "a")
    found: list[bytes] = []

    def work() -> None:
        while claims := claimed(store):
            for claim in claims:
                store.settle_upload(Settled(claim, "released", (report(claim.upload.body[-1]),)))
            found.extend(numbers(claims))

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(found) == [bytes([number]) for number in range(60)]
    assert store.counts().reports == 60


def test_uploads_survive_closing_and_opening(maker: Maker) -> None:
    first = maker.open()
    first.put_upload(flags(), "a")
    first.close()
    with maker.open() as second:
        assert len(second.claim_uploads("a", 8, 10.0)) == 1


@pytest.mark.parametrize("bad", [{"vehicle": ""}, {"form": "gaussians"}, {"form": "letter"}])
def test_an_upload_that_cannot_be_is_refused(bad: dict[str, str]) -> None:
    with pytest.raises(StoreError, match="upload of form"):
        replace(flags(), **bad)  # type: ignore[arg-type]


def test_the_clock_of_leases_is_one_for_all_processes_of_the_machine() -> None:
    ask = "from gnd.tile_store import clocks; print(clocks.boot_id(), clocks.steady_ns())"
    before_ns = clocks.steady_ns()
    *boot, now_ns = subprocess.check_output([sys.executable, "-c", ask], text=True).split(" ")
    assert boot == [clocks.boot_id()]
    assert before_ns < int(now_ns) < clocks.steady_ns()


def test_a_patient_upload_goes_with_the_commit_of_another(store: Store):
    """And comes to its end alone where nobody else commits."""
    assert store.put_upload(flags(1), "a", 0.05) == "stored"
    done: list[str] = []
    patient = threading.Thread(target=lambda: done.append(store.put_upload(flags(2), "a", 600.0)))
    patient.start()
    while not done:
        store.put_upload(flags(3), "a")
        patient.join(0.01)
    patient.join(20.0)
    assert done == ["stored"]


def test_a_store_that_is_closed_finishes_what_is_patient(tmp_path):
    store = SqliteStore(tmp_path / "store.sqlite")
    done: list[str] = []
    patient = threading.Thread(target=lambda: done.append(store.put_upload(flags(), "a", 0.3)))
    patient.start()
    while not store._writer._patient and not done:
        patient.join(0.001)
    store.close()
    patient.join(20.0)
    assert done == ["stored"]


def test_no_vehicle_comes_first_because_of_its_name(store: Store, monkeypatch):
    """Many invented names that sort before all others do not hide those from the look."""
    monkeypatch.setattr(sql_uploads, "MOST_TURNS", 4)
    for number in range(10):
        store.put_upload(replace(flags(number), vehicle=f"a-{number}"), "a")
    store.put_upload(replace(flags(10), vehicle="z"), "a")
    seen: set[str] = set()

    def in_turn(vehicles: list[str]) -> list[str]:
        seen.update(vehicles)
        return []

    for _ in range(4):
        assert store.claim_uploads("a", 8, 10.0, in_turn) == []
    assert seen == {"z", *(f"a-{number}" for number in range(10))}
