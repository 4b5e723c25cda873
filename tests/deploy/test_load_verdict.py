"""Whether a cloud has kept up: of runs in which it has not, the verdict says so and why."""

from dataclasses import replace

import pytest

from gnd.deploy.load.audit import Backlog, LoadLedger, MergedTiles
from gnd.deploy.load.plan import LoadOptions
from gnd.deploy.load.sending import SenderAccount
from gnd.deploy.load.verdict import LoadOutcome, summary, why_not

N, RUN_S = 200, 100.0


def account(number, **given):
    at_s = RUN_S * number / N
    known = {
        "report_id": f"r{number}",
        "vehicle": "v",
        "due_s": at_s,
        "sent_s": at_s + 0.001,
        "acked_s": at_s + 0.011,
        "ack": "stored",
        "word_s": at_s + 0.1,
        "released_s": at_s + 0.2,
        "status": "released",
    }
    return SenderAccount(**known | given)


def good(**changes):
    """A run with which nothing is wrong."""
    accounts = changes.pop("accounts", [account(n) for n in range(N)])
    ids = frozenset(one.report_id for one in accounts)
    ledger = LoadLedger(
        journaled=ids,
        with_gaussians=frozenset(),
        kept=dict.fromkeys(ids, "released"),
        merged=tuple(MergedTiles(1, n + 2, RUN_S * n / N, 0.5) for n in range(N)),
        unmerged=0,
        aside=0,
        quarantined=0,
    )
    known = {
        "options": LoadOptions(vehicles=10),
        "planned": N,
        "accounts": accounts,
        "backlog": [Backlog(0.5 * k, 2, 1, k) for k in range(int(2 * RUN_S) + 4)],
        "start_s": 0.0,
        "offered_s": RUN_S,
        "drained_s": RUN_S + 1.0,
        "cpu_s": {"router": 1.0, "workers": 3.0},
        "client_cpu_s": 2.0,
        "machine_cpu_s": 10.0,
        "capacity_s": 2 * RUN_S,
        "ledger": ledger,
        "notices_s": {(1, n + 2): RUN_S * n / N + 0.6 for n in range(N)},
    }
    return LoadOutcome(**known | changes)


def test_a_run_with_which_nothing_is_wrong():
    told = summary(good())
    assert told["kept_up"] is True
    assert why_not(good()) == []
    assert list(told)[:9] == [
        "vehicles", "reports", "acknowledged", "lost", "acks_per_s", "ack_ms", "cpu_ms_per_report", "merge_lag_s",
        "kept_up",
    ]  # fmt: skip
    assert (told["vehicles"], told["reports"], told["acknowledged"], told["lost"]) == (10, N, N, 0)
    assert told["acks_per_s"] == pytest.approx(2.0)
    assert told["ack_ms"] == pytest.approx({"p50": 10.0, "p99": 10.0})
    assert told["cpu_ms_per_report"] == pytest.approx(20.0)
    assert told["cpu_ms_by_part"] == pytest.approx({"router": 5.0, "workers": 15.0})
    assert told["merge_lag_s"] == {"p50": 0.5, "p95": 0.5, "max": 0.5}
    assert told["notice_lag_s"]["p95"] == pytest.approx(0.6)
    assert told["cpu_share"] == {"cloud": 0.02, "clients": 0.01, "others": 0.02}
    assert told["limit"] == "none"


def said(outcome):
    assert summary(outcome)["kept_up"] is False
    return "; ".join(why_not(outcome))


def test_a_queue_that_grows():
    backlog = [Backlog(0.5 * k, 2 + k, 1, k) for k in range(int(2 * RUN_S))]
    assert "the queue grew" in said(good(backlog=backlog))


def test_a_queue_that_is_never_empty():
    outcome = good(drained_s=None)
    assert "the queue was not empty" in said(outcome)
    assert summary(outcome)["cpu_ms_per_report"] is None  # what is not done yet costs, too


def test_reports_that_were_not_offered_at_the_pace():
    late = [account(n, sent_s=RUN_S * n / N + (3.0 if n % 10 == 0 else 0.0)) for n in range(N)]
    assert "20 of 200 reports were sent more than 1 s late" in said(good(accounts=late))
    assert summary(good(accounts=late))["limit"] == "clients"
    assert "only 200 of 400" in said(good(planned=400))
    assert said(good(accounts=[])).startswith("nothing was sent")


def test_reports_that_are_lost():
    whole = good().ledger
    for journaled, kept in ((whole.journaled - {"r7"}, {"r7": "released"}), (whole.journaled - {"r7"}, {})):
        outcome = good(ledger=replace(whole, journaled=journaled, kept=kept))
        assert summary(outcome)["lost"] == 1
        assert "1 acknowledged reports are lost" in said(outcome)
    waiting = good(ledger=replace(whole, journaled=whole.journaled - {"r7"}, kept={"r7": "waiting"}))
    assert summary(waiting)["lost"] == 0  # it is durable, but nobody has looked at it


def test_reports_that_nobody_acknowledged_or_released():
    accounts = [account(n, **({"ack": "", "acked_s": 0.0} if n == 3 else {})) for n in range(N)]
    assert "1 reports were not acknowledged" in said(good(accounts=accounts))
    accounts = [account(n, **({"released_s": 0.0} if n == 3 else {})) for n in range(N)]
    assert "were not released" in said(good(accounts=accounts))
    accounts = [account(n, **({"status": "quarantined"} if n == 3 else {})) for n in range(N)]
    assert "1 reports were refused" in said(good(accounts=accounts))


def test_vehicles_that_wait_longer_and_longer():
    accounts = [account(n, word_s=RUN_S * n / N + 0.1 + 5.0 * n / N) for n in range(N)]
    assert "p95 of the wait for word" in said(good(accounts=accounts))
    unheard = [account(n, **({"word_s": 0.0} if n > 150 else {})) for n in range(N)]
    assert "p95 of the wait for word" in said(good(accounts=unheard))


def test_tiles_that_are_merged_later_and_later():
    merged = tuple(MergedTiles(1, n + 2, float(n), 0.5 + 4.0 * n / N) for n in range(N))
    assert "p95 of the wait for merge" in said(good(ledger=replace(good().ledger, merged=merged)))


def test_tiles_that_always_wait_for_long():
    merged = tuple(MergedTiles(1, n + 2, float(n), 7.0) for n in range(N))
    assert "95 % of the report parts were merged within 7.0 s only" in said(
        good(ledger=replace(good().ledger, merged=merged))
    )


def test_what_is_left_undone():
    ledger = good().ledger
    assert "3 report parts are not merged" in said(good(ledger=replace(ledger, unmerged=3)))
    assert "1 tiles are set aside" in said(good(ledger=replace(ledger, aside=1)))
    assert "2 messages are in quarantine" in said(good(ledger=replace(ledger, quarantined=2)))
    assert "1 processes of the cloud had to be started again" in said(good(restarts=1))


def test_a_run_that_was_interrupted():
    assert said(good(interrupted=True)) == "the run was interrupted"
    assert summary(good(interrupted=True))["limit"] == "none"


def test_a_run_too_short_to_tell():
    assert "too short" in said(good(backlog=[Backlog(0.0, 0, 0, 0)]))
