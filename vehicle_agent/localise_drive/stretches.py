"""The health timeline: stretches of the drive in which health and cause stay the same."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Final

from gnd.vehicle_agent.localise.estimates import Cause, Health
from gnd.vehicle_agent.localise_drive.run import Moment

HEALTHS: Final[tuple[Health, ...]] = ("good", "degraded", "lost")


@dataclass(frozen=True, slots=True)
class HealthStretch:
    """From its first scan (or when it changed) to the first of the next stretch (the last scan, for the last one)."""

    health: Health
    cause: Cause
    first_ns: int
    from_s: float
    """After the drive's first scan."""
    to_s: float
    from_m: float
    """Way since the recording's start, by the wheels."""
    to_m: float
    scans: int

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "health": self.health,
            "cause": self.cause,
            "t_ns": self.first_ns,
            "from_s": round(self.from_s, 3),
            "to_s": round(self.to_s, 3),
            "from_m": round(self.from_m, 2),
            "to_m": round(self.to_m, 2),
            "scans": self.scans,
        }


def stretches_of(moments: Sequence[Moment]) -> list[HealthStretch]:
    """The stretches in order of time."""
    groups = [list(group) for _, group in groupby(moments, key=lambda m: (m.health, m.cause))]
    ends = [group[0] for group in groups[1:]] + [group[-1] for group in groups[-1:]]
    return [_stretch(group, end, moments[0].t_ns) for group, end in zip(groups, ends, strict=True)]


def _stretch(group: Sequence[Moment], end: Moment, start_ns: int) -> HealthStretch:
    first = group[0]
    return HealthStretch(
        health=first.health,
        cause=first.cause,
        first_ns=first.t_ns,
        from_s=(first.t_ns - start_ns) * 1e-9,
        to_s=(end.t_ns - start_ns) * 1e-9,
        from_m=first.way_m,
        to_m=end.way_m,
        scans=sum(moment.of_scan for moment in group),
    )


def health_shares(stretches: Iterable[HealthStretch]) -> dict[str, dict[str, float]]:
    """Seconds, metres and scans of each health."""
    found: dict[str, dict[str, float]] = {health: {"s": 0.0, "m": 0.0, "scans": 0} for health in HEALTHS}
    for stretch in stretches:
        share = found[stretch.health]
        share["s"] = round(share["s"] + stretch.to_s - stretch.from_s, 3)
        share["m"] = round(share["m"] + stretch.to_m - stretch.from_m, 2)
        share["scans"] += stretch.scans
    return found
