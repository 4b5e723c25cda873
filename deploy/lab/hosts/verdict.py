"""What a run over hosts has found: per fault how long nobody was served, and whether anything is missing at the end."""

import itertools
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from gnd.deploy.chaos.checks import Findings

LONGEST_GAP_S: Final = 5.0


@dataclass(frozen=True, slots=True)
class HostTrial:
    """One fault, as it was.

    Attributes:
        fault: its name.
        where: what was hit.
        began_s, ended_s: when, s of the machine's monotonic clock.
        until_s: when its account ends: all regions have been served for a while, or the time for that was over.
        is_cut: whether its region could not be served while it lasted.
        region: that it was about; the last.
        acks_s: by region when reports were acknowledged.
        tiles_s: by region when tiles came.
        versions_s: by region when new versions were heard of.
        is_bodiless: whether bodies could not be read or written while it lasted: only tiles that somebody remembered
            could be had, and nothing was published.
        is_untimely: whether a clock was so wrong while it lasted that seals did not count: reports wait for it.
    """

    fault: str
    where: str
    began_s: float
    ended_s: float
    until_s: float
    is_cut: bool
    region: int
    acks_s: Sequence[Sequence[float]] = field(repr=False)
    tiles_s: Sequence[Sequence[float]] = field(repr=False)
    versions_s: Sequence[Sequence[float]] = field(repr=False)
    is_bodiless: bool = False
    is_untimely: bool = False

    @property
    def ack_gap_s(self) -> float:
        """The longest time in which the vehicles of a region got no acknowledgement; a cut region does not count."""
        return self._gap_s(self.acks_s)

    @property
    def tile_gap_s(self) -> float:
        """The same for tiles."""
        return self._gap_s(self.tiles_s)

    @property
    def version_gap_s(self) -> float:
        """The same for notices of new versions: publishing. Without a fault there is a pause of some seconds, too."""
        return self._gap_s(self.versions_s)

    @property
    def back_s(self) -> float | None:
        """How long after its end a cut region had an acknowledgement and a tile again, every region a tile and a new
        version (bodies), or an acknowledgement (clocks); None: nothing was kept from any.
        """
        if not self.is_cut and not self.is_bodiless and not self.is_untimely:
            return None
        served = [self.acks_s[self.region], self.tiles_s[self.region]]
        if self.is_bodiless:
            served = [*self.tiles_s, *self.versions_s]
        if self.is_untimely:
            served = [*self.acks_s]
        return max(next((t for t in times_s if t > self.ended_s), self.until_s) for times_s in served) - self.ended_s

    @property
    def counted_gap_s(self) -> float:
        """The time without a service that must not end."""
        if self.is_untimely:
            return self.tile_gap_s
        return self.ack_gap_s if self.is_bodiless else max(self.ack_gap_s, self.tile_gap_s)

    @property
    def acknowledged(self) -> int:
        """Acknowledgements from its begin to the end of its account."""
        return sum(self.began_s <= t <= self.until_s for times_s in self.acks_s for t in times_s)

    def _gap_s(self, by_region: Sequence[Sequence[float]]) -> float:
        counted = [times_s for region, times_s in enumerate(by_region) if not (self.is_cut and region == self.region)]
        return max(longest_gap_s(times_s, self.began_s, self.until_s) for times_s in counted)

    def as_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return {
            "fault": self.fault,
            "where": self.where,
            "lasted_s": round(self.ended_s - self.began_s, 2),
            "acknowledged": self.acknowledged,
            "ack_gap_s": round(self.ack_gap_s, 2),
            "tile_gap_s": round(self.tile_gap_s, 2),
            "version_gap_s": round(self.version_gap_s, 2),
            "back_s": None if self.back_s is None else round(self.back_s, 2),
        }


def longest_gap_s(times_s: Sequence[float], from_s: float, until_s: float) -> float:
    """The longest pause between services that ends after `from_s`, up to `until_s`, s.

    Args:
        times_s: when there was one, in order.
        from_s: a pause that began before counts from here.
        until_s: one that lasts longer is counted up to here.
    """
    inside = [from_s, *(t for t in times_s if from_s < t < until_s), until_s]
    return max(b - a for a, b in itertools.pairwise(inside))


@dataclass(frozen=True, slots=True)
class FaultSpread:
    """What one fault cost in all its trials: each pair is the mean and the worst, s; None: it does not apply.

    Attributes:
        fault: its name.
        times: how often it was inflicted.
        ack_gap_s, tile_gap_s, version_gap_s, back_s: see `HostTrial`.
    """

    fault: str
    times: int
    ack_gap_s: tuple[float, float]
    tile_gap_s: tuple[float, float]
    version_gap_s: tuple[float, float]
    back_s: tuple[float, float] | None

    @classmethod
    def of(cls, trials: Sequence[HostTrial]) -> "FaultSpread":
        """Of the trials of one fault, at least one."""
        back_s = [one.back_s for one in trials if one.back_s is not None]
        return cls(
            trials[0].fault,
            len(trials),
            _mean_and_worst([one.ack_gap_s for one in trials]),
            _mean_and_worst([one.tile_gap_s for one in trials]),
            _mean_and_worst([one.version_gap_s for one in trials]),
            _mean_and_worst(back_s) if back_s else None,
        )

    def as_dict(self) -> dict[str, Any]:
        """JSON-able."""
        names = ("ack_gap_s", "tile_gap_s", "version_gap_s", "back_s")
        pairs: dict[str, tuple[float, float] | None] = {name: getattr(self, name) for name in names}
        told = {
            name: None if pair is None else {"mean": round(pair[0], 2), "worst": round(pair[1], 2)}
            for name, pair in pairs.items()
        }
        return {"fault": self.fault, "times": self.times, **told}


def _mean_and_worst(values: Sequence[float]) -> tuple[float, float]:
    return statistics.fmean(values), max(values)


@dataclass(frozen=True, slots=True)
class HostsOutcome:
    """A run that has ended.

    Attributes:
        plan: parts by host.
        size: regions, hosts, vehicles of a region.
        seed: of the reports.
        calm: nothing was inflicted: the longest pauses of the same laboratory without a fault.
        trials: the faults.
        findings: of all reports of the run.
        settled_s: how long it took at the end until nothing was left to do; None: it was not done in time.
        longest_gap_s: allowed.
        interrupted: by Ctrl-C.
        restarts: how often each process was started again by the supervisor.
        died: parts that would not live.
        chaos: the faults of chaos, as `gnd chaos` tells them.
    """

    plan: dict[str, list[str]]
    size: dict[str, int]
    seed: int
    calm: HostTrial | None
    trials: tuple[HostTrial, ...]
    findings: Findings
    settled_s: float | None
    longest_gap_s: float
    interrupted: bool
    restarts: dict[str, int]
    died: tuple[str, ...]
    chaos: tuple[dict[str, Any], ...] = ()

    @property
    def failures(self) -> list[str]:
        """What must not be, in words; empty: all guarantees were kept."""
        late = [
            f"{one.fault} ({one.where}): {one.counted_gap_s:.1f} s without service"
            for one in self.trials
            if one.counted_gap_s > self.longest_gap_s
        ]
        unsettled = ["it did not settle"] if self.settled_s is None else []
        return self.findings.failures + late + unsettled + list(self.died)

    @property
    def by_fault(self) -> tuple[FaultSpread, ...]:
        """Each fault over all its trials, in the order in which they came first."""
        names = dict.fromkeys(one.fault for one in self.trials)
        return tuple(FaultSpread.of([one for one in self.trials if one.fault == name]) for name in names)

    def as_dict(self) -> dict[str, Any]:
        """JSON-able."""
        told = self.findings.as_dict()
        head = (
            "acknowledged",
            "lost",
            "doubled",
            "stuck_tiles",
            "identical_map",
            "unreleased",
            "versions",
            "signed",
            "damages",
            "verify",
        )
        return {
            **self.size,
            "seed": self.seed,
            "plan": self.plan,
            **{name: told[name] for name in head},
            "failures": self.failures,
            "settled_s": None if self.settled_s is None else round(self.settled_s, 1),
            "interrupted": self.interrupted,
            "calm": None if self.calm is None else self.calm.as_dict(),
            "faults": [trial.as_dict() for trial in self.trials],
            "by_fault": [spread.as_dict() for spread in self.by_fault],
            "chaos": list(self.chaos),
            "restarts": self.restarts,
            "found": told["found"],
        }
