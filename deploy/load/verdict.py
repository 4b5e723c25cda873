"""The result of a load, and whether the cloud kept up with it."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from gnd.deploy.load.audit import Backlog, LoadLedger
from gnd.deploy.load.plan import LoadOptions
from gnd.deploy.load.sending import SenderAccount

F64 = npt.NDArray[np.float64]
LATE_S: Final = 1.0
"""A report that is sent so long after it was due was not sent at the pace of the drive."""
ON_TIME: Final = 0.99
"""Share of reports that must be sent at that pace."""
GROWTH_S: Final = 1.0
"""From the third quarter of a run to the last one the queue may grow by the reports of so long a time."""
SLOW_ACK_S: Final = 0.25
LAG_FACTOR: Final = 2.0
LAG_S: Final = 1.0
"""The last tenth of the reports may wait twice as long as the first one, or so long."""
LONGEST_LAG_S: Final = 5.0
"""Of all report parts 95 % must be in a version so soon: a queue that only stays as long as it was is not enough."""


@dataclass(frozen=True, slots=True)
class LoadOutcome:
    """All that was measured.

    Attributes:
        options: of the load.
        planned: reports that were to be sent; None: those of which a time bound decides.
        accounts: of each report that was begun.
        backlog: what waited, every half second, from the start until all was done.
        start_s, offered_s: when the first report was due, when the last one had been sent, monotonic.
        drained_s: when nothing waited any more; None: something still did when the time was over.
        cpu_s: CPU seconds of the cloud's parts over that time.
        client_cpu_s: of the clients and of the process that watches over them.
        machine_cpu_s: of all programs of the machine.
        capacity_s: what all its cores could have done.
        ledger: what the store holds.
        notices_s: when the subscriber had heard of each (tile, version), s UTC.
        restarts: how often a process of the cloud was started again.
        interrupted: whether somebody ended the run before its time.
        unsigned: versions that nobody answers for, where there are certificates; None: there are none.
        hosts: what ran where, on several hosts.
    """

    options: LoadOptions
    planned: int | None
    accounts: Sequence[SenderAccount]
    backlog: Sequence[Backlog]
    start_s: float
    offered_s: float
    drained_s: float | None
    cpu_s: Mapping[str, float]
    client_cpu_s: float
    machine_cpu_s: float
    capacity_s: float
    ledger: LoadLedger
    notices_s: Mapping[tuple[int, int], float] = field(repr=False)
    restarts: int = 0
    interrupted: bool = False
    unsigned: int | None = None
    hosts: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @property
    def sent(self) -> list[SenderAccount]:
        """The reports that were sent, in the order of their times."""
        return sorted((one for one in self.accounts if one.sent_s), key=lambda one: one.sent_s)

    @property
    def acknowledged(self) -> list[SenderAccount]:
        """Those that were acknowledged."""
        return [one for one in self.sent if one.is_acknowledged]

    @property
    def lost(self) -> int:
        """Acknowledged reports that the store does not hold."""
        return len(self.ledger.lost(frozenset(one.report_id for one in self.acknowledged)))

    @property
    def wall_s(self) -> float:
        """From the first report to the last one."""
        return max(self.offered_s - self.start_s, 1e-3)

    def cpu_ms(self, used_s: float) -> float | None:
        """CPU a report, ms; None: not all was merged, and what is not done yet costs, too."""
        done = self.drained_s is not None and self.acknowledged
        return _rounded(1e3 * used_s / len(self.acknowledged)) if done else None


def why_not(outcome: LoadOutcome) -> list[str]:
    """What speaks against the cloud having kept up; nothing: it has."""
    if outcome.interrupted:
        return ["the run was interrupted"]
    found = [*_not_offered(outcome), *_not_done(outcome), *_growing(outcome), *_lagging(outcome)]
    return [one for one in found if one]


def _not_offered(outcome: LoadOutcome) -> Iterable[str]:
    sent = outcome.sent
    if not sent:
        return ["nothing was sent"]
    found = []
    if outcome.planned is not None and len(sent) < outcome.planned:
        found.append(f"only {len(sent)} of {outcome.planned} reports were sent")
    if outcome.options.pace == "real":
        late = sum(one.sent_s - one.due_s > LATE_S for one in sent)
        if late > (1.0 - ON_TIME) * len(sent):
            found.append(f"{late} of {len(sent)} reports were sent more than {LATE_S:g} s late")
    return found


def _not_done(outcome: LoadOutcome) -> Iterable[str]:
    sent, ledger = outcome.sent, outcome.ledger
    missing = len(sent) - len(outcome.acknowledged)
    open_ones = sum(not one.released_s for one in outcome.acknowledged)
    refused = sum(one.status == "quarantined" for one in sent)
    drain_s = outcome.options.drain_s
    counts = (
        (missing, "reports were not acknowledged"),
        (outcome.lost, "acknowledged reports are lost"),
        (refused, "reports were refused"),
        (open_ones, f"acknowledged reports were not released {drain_s:g} s after the last one"),
        (ledger.unmerged, "report parts are not merged"),
        (ledger.aside, "tiles are set aside"),
        (ledger.quarantined, "messages are in quarantine"),
        (outcome.restarts, "processes of the cloud had to be started again"),
        (outcome.unsigned or 0, "versions are not signed by who may"),
    )
    found = [f"{count} {what}" for count, what in counts if count]
    if outcome.drained_s is None:
        found.append(f"the queue was not empty {drain_s:g} s after the last report")
    return found


def _growing(outcome: LoadOutcome) -> Iterable[str]:
    third, last = (_least_items(outcome, part) for part in ((0.5, 0.75), (0.75, 1.0)))
    if third is None or last is None:
        return ["the run was too short to see whether the queue grows"]
    allowed = GROWTH_S * len(outcome.sent) / outcome.wall_s
    if last - third > allowed:
        return [f"the queue grew: at least {third} waited in the third quarter, {last} in the last"]
    return []


def _least_items(outcome: LoadOutcome, part: tuple[float, float]) -> int | None:
    """The shortest that the queue was: reports come in bursts, and one that is worked off is short between them."""
    first_s, last_s = (outcome.start_s + share * outcome.wall_s for share in part)
    items = [one.items for one in outcome.backlog if first_s <= one.at_s <= last_s]
    return min(items, default=None)


def _lagging(outcome: LoadOutcome) -> Iterable[str]:
    """How long vehicles wait for an answer, and tiles for their merge: the end compared with the beginning."""
    sent = outcome.sent
    n = max(1, len(sent) // 10)
    found = []
    waits = np.array([_word_lag_s(one) for one in sent])
    merged = sorted(outcome.ledger.merged, key=lambda one: one.received_s)
    lags, m = np.array([one.lag_s for one in merged]), max(1, len(merged) // 10)
    if len(lags) and (p95 := float(np.quantile(lags, 0.95))) > LONGEST_LAG_S:
        found.append(f"95 % of the report parts were merged within {p95:.1f} s only")
    for what, first, last in (("word", waits[:n], waits[-n:]), ("merge", lags[:m], lags[-m:])):
        if not len(first):
            continue
        a, b = (float(np.quantile(part, 0.95, method="higher")) for part in (first, last))
        if b > max(LAG_FACTOR * a, LAG_S):
            found.append(f"p95 of the wait for {what}: {a:.2f} s in the first tenth, {b:.2f} s in the last")
    return found


def _word_lag_s(one: SenderAccount) -> float:
    return one.word_s - one.sent_s if one.word_s else np.inf


def summary(outcome: LoadOutcome) -> dict[str, Any]:
    """The figures as plain values; the first keys are those that the issue names."""
    sent, acknowledged = outcome.sent, outcome.acknowledged
    took_ms = 1e3 * np.array([one.acked_s - one.sent_s for one in acknowledged])
    reasons = why_not(outcome)
    return {
        "vehicles": outcome.options.vehicles,
        "reports": len(sent),
        "acknowledged": len(acknowledged),
        "lost": outcome.lost,
        "acks_per_s": _rounded(len(acknowledged) / outcome.wall_s),
        "ack_ms": _quantiles(took_ms, {"p50": 0.5, "p99": 0.99}),
        "cpu_ms_per_report": outcome.cpu_ms(sum(outcome.cpu_s.values())),
        "merge_lag_s": _quantiles(np.array([one.lag_s for one in outcome.ledger.merged]), _LAGS),
        "kept_up": not reasons,
        "why_not": reasons,
        "cpu_ms_by_part": {name: outcome.cpu_ms(used_s) for name, used_s in outcome.cpu_s.items()},
        "notice_lag_s": _quantiles(_notice_lags_s(outcome), _LAGS),
        "word_s": _quantiles(np.array([_word_lag_s(one) for one in acknowledged if one.word_s]), _LAGS),
        "second_halves": sum(one.halves for one in sent),
        "sent_whole": sum(one.whole for one in sent),
        "questions": sum(one.questions for one in sent),
        "versions": len({(one.tile, one.version) for one in outcome.ledger.merged}),
        "offered_s": _rounded(outcome.wall_s),
        "drained_after_s": None if outcome.drained_s is None else _rounded(outcome.drained_s - outcome.offered_s),
        "backlog_max": max((one.items for one in outcome.backlog), default=0),
        "cpu_share": cpu_shares(outcome),
        "limit": limit_of(outcome, reasons),
        "streets": outcome.options.streets,
        "km": outcome.options.km,
        "kmh": outcome.options.kmh,
        "changed_share": outcome.options.changed_share,
        "shards": outcome.options.shards,
        "seed": outcome.options.seed,
        "pace": outcome.options.pace,
        "secure": outcome.unsigned is not None,
        "hosts": {name: list(parts) for name, parts in outcome.hosts.items()},
    }


_LAGS: Final = {"p50": 0.5, "p95": 0.95, "max": 1.0}


def _notice_lags_s(outcome: LoadOutcome) -> F64:
    """From the receipt of the last report part that a version was made of, to its notice at the subscriber."""
    decided: dict[tuple[int, int], float] = {}
    for one in outcome.ledger.merged:
        at = (one.tile, one.version)
        decided[at] = max(decided.get(at, 0.0), one.received_s)
    heard = outcome.notices_s
    return np.array([heard[at] - received_s for at, received_s in decided.items() if at in heard])


def cpu_shares(outcome: LoadOutcome) -> dict[str, float]:
    """Shares of all cores that the cloud, the clients and other programs used, from the start until all was done."""
    cloud_s, clients_s = sum(outcome.cpu_s.values()), outcome.client_cpu_s
    used_s = {"cloud": cloud_s, "clients": clients_s, "others": max(0.0, outcome.machine_cpu_s - cloud_s - clients_s)}
    return {name: round(s / outcome.capacity_s, 3) for name, s in used_s.items()}


def limit_of(outcome: LoadOutcome, reasons: Sequence[str]) -> str:
    """Who could not do more: "cloud", "clients", "none" where nobody was at the limit.

    Clients are, where the cloud has kept up with all that they sent, but they were late or sent as fast as they could.
    """
    if outcome.interrupted:
        return "none"
    late = set(_not_offered(outcome))
    if set(reasons) - late:
        return "cloud"
    acks_s = [one.acked_s - one.sent_s for one in outcome.acknowledged]
    if late and acks_s and float(np.median(acks_s)) > SLOW_ACK_S:
        return "cloud"  # all that may be under way waits for acks
    return "clients" if late or outcome.options.pace == "max" else "none"


def _quantiles(values: F64, which: Mapping[str, float]) -> dict[str, float | None]:
    return {name: _rounded(float(np.quantile(values, q))) if len(values) else None for name, q in which.items()}


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")
