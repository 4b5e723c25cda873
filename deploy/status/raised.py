"""Which alerts a look at the cloud raises, by the thresholds that Prometheus has, too, and what to do about each."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal

from gnd.deploy.status.figures import CloudFigures
from gnd.deploy.status.thresholds import HOURS_A_DAY, AlertThresholds

Severity = Literal["warning", "critical"]
EXIT_CODE: Final[dict[Severity, int]] = {"warning": 1, "critical": 2}
"""Of `gnd status --check`, as Nagios and its kin read it; 0 where nothing is raised."""
_MB: Final = 1e6
_GB: Final = 1e9
_HOUR_S: Final = 3600.0


@dataclass(frozen=True, slots=True)
class RaisedAlert:
    """Something an operator should look at.

    Attributes:
        alert: its name, that of the rule of Prometheus.
        severity: "critical": vehicles notice it, or soon will.
        says: what it is, with figures.
        do: what to do; docs/operations.md has it at length.
    """

    alert: str
    severity: Severity
    says: str
    do: str


def raised_by(figures: CloudFigures, thresholds: AlertThresholds) -> list[RaisedAlert]:
    """The alerts of one look, critical ones first. Prometheus waits until one lasts, this does not."""
    found = [
        *_shards(figures),
        *_queue(figures, thresholds),
        *_kept(figures, thresholds),
        *_disk(figures, thresholds),
        *_certificate(figures, thresholds),
    ]
    return sorted(found, key=lambda one: one.severity)


def exit_code(raised: list[RaisedAlert]) -> int:
    """0, 1 where there are warnings, 2 where something is critical."""
    return max((EXIT_CODE[one.severity] for one in raised), default=0)


def _shards(figures: CloudFigures) -> Iterator[RaisedAlert]:
    if not figures.alive:
        yield RaisedAlert(
            "GndNoShard", "critical", "no shard merges: reports are not acknowledged", "start one: gnd merger"
        )
    for name in figures.silent:
        yield RaisedAlert(
            "GndShardSilent",
            "warning",
            f"shard {name} was not heard of, and has not ended as it should",
            "look at its log, and start it again",
        )


def _queue(figures: CloudFigures, limits: AlertThresholds) -> Iterator[RaisedAlert]:
    queue, lag_s = figures.queue, figures.queue.lag_s(0.95)
    look = "do shards live, does a CPU or the database stand at its limit?"
    if queue.overdue_s > limits.queue_overdue_s:
        says = f"a ready tile has waited {queue.overdue_s:.0f} s for its merge"
        yield RaisedAlert("GndQueueOverdue", "critical", says, look)
    if queue.waiting_s > limits.report_waiting_s:
        says = f"the oldest report that no merge has read waits {queue.waiting_s:.0f} s"
        yield RaisedAlert("GndReportsWait", "warning", says, look)
    if lag_s is not None and lag_s > limits.merge_lag_s:
        says = f"one report in twenty takes longer than {lag_s:.0f} s to a version"
        yield RaisedAlert("GndMergesSlow", "warning", says, look)


def _kept(figures: CloudFigures, limits: AlertThresholds) -> Iterator[RaisedAlert]:
    if figures.tiles_set_aside > limits.tiles_set_aside:
        yield RaisedAlert(
            "GndTilesSetAside",
            "warning",
            f"{figures.tiles_set_aside} tiles cannot be merged; their reports wait",
            "gnd map status says why; mend it, then gnd map retry",
        )
    if figures.queue.quarantined_bytes > limits.quarantine_mb * _MB:
        yield RaisedAlert(
            "GndQuarantineFull",
            "warning",
            f"{figures.queue.quarantined_bytes / _MB:.1f} MB of messages that cannot be read are kept",
            "gnd map quarantine says from whom and why",
        )


def _disk(figures: CloudFigures, limits: AlertThresholds) -> Iterator[RaisedAlert]:
    if figures.disk.free_bytes is None:
        return
    free_gb = figures.disk.free_bytes / _GB
    says, do = f"{free_gb:.2f} GB are free on the store's disk", "free space there, or gnd map gc"
    if free_gb < limits.disk_full_gb:
        yield RaisedAlert("GndDiskFull", "critical", says, do)
    elif free_gb < limits.disk_low_gb:
        yield RaisedAlert("GndDiskLow", "warning", says, do)


def _certificate(figures: CloudFigures, limits: AlertThresholds) -> Iterator[RaisedAlert]:
    if figures.certificate_s is None:
        return
    hours = figures.certificate_s / _HOUR_S
    says = f"the certificate in use holds {hours:.1f} h" if hours > 0 else "the certificate in use has expired"
    if hours < limits.certificate_hours:
        yield RaisedAlert("GndCertificateEnds", "critical", says, "gnd certs renew FOLDER, at once")
    elif hours < HOURS_A_DAY * limits.certificate_days:
        yield RaisedAlert("GndCertificateEndsSoon", "warning", says, "gnd certs renew FOLDER")
