"""What a run over hosts has found: per fault how long nobody was served, and whether anything is missing at the end."""

import itertools
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

    @property
    def ack_gap_s(self) -> float:
        """The longest time in which the vehicles of a region got no acknowledgement; a cut region does not count."""
        return self._gap_s(self.acks_s)

    @property
    def tile_gap_s(self) -> float:
        """The same for tiles."""
        return self._gap_s(self.tiles_s)

    @property
    def back_s(self) -> float | None:
        """How long after its end a cut region had an acknowledgement and a tile again; None: none was cut."""
        if not self.is_cut:
            return None
        served = self.acks_s[self.region], self.tiles_s[self.region]
        return max(next((t for t in times_s if t > self.ended_s), self.until_s) for times_s in served) - self.ended_s

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

    @property
    def failures(self) -> list[str]:
        """What must not be, in words; empty: all guarantees were kept."""
        late = [
            f"{one.fault} ({one.where}): {max(one.ack_gap_s, one.tile_gap_s):.1f} s without service"
            for one in self.trials
            if max(one.ack_gap_s, one.tile_gap_s) > self.longest_gap_s
        ]
        unsettled = ["it did not settle"] if self.settled_s is None else []
        return self.findings.failures + late + unsettled + list(self.died)

    def as_dict(self) -> dict[str, Any]:
        """JSON-able."""
        told = self.findings.as_dict()
        head = ("acknowledged", "lost", "doubled", "stuck_tiles", "identical_map", "unreleased", "versions", "verify")
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
            "restarts": self.restarts,
            "found": told["found"],
        }
