"""Which faults a seed draws, and when: the same seed gives the same list."""

import random
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal

Group = Literal["kill", "stop", "line", "disk", "page", "clock", "message"]


@dataclass(frozen=True, slots=True)
class FaultKind:
    """A way to hurt the cloud.

    Attributes:
        name: as the account names it.
        group: what is done.
        part: to which part: "router", "store", "shard", "worker", "vehicle", "follower"; "" none in particular. Of
            pages: which one is killed with it.
        held_s: between these it lasts; (0, 0): it is over at once.
    """

    name: str
    group: Group
    part: str
    held_s: tuple[float, float] = (0.0, 0.0)


_STOPPED_S: Final = (0.4, 1.6)
KINDS: Final = (
    FaultKind("kill router", "kill", "router"),
    FaultKind("kill store", "kill", "store"),
    FaultKind("kill shard", "kill", "shard"),
    FaultKind("kill worker", "kill", "worker"),
    FaultKind("kill vehicle", "kill", "vehicle"),
    FaultKind("kill follower", "kill", "follower"),
    FaultKind("stop router", "stop", "router", _STOPPED_S),
    FaultKind("stop store", "stop", "store", _STOPPED_S),
    FaultKind("stop shard", "stop", "shard", (0.5, 3.0)),
    FaultKind("stop worker", "stop", "worker", (0.5, 4.0)),
    FaultKind("stop vehicle", "stop", "vehicle", _STOPPED_S),
    FaultKind("stall follower", "stop", "follower", (2.0, 6.0)),
    FaultKind("cut line", "line", "", (0.3, 2.0)),
    FaultKind("late line", "line", "", (0.5, 4.0)),
    FaultKind("full disk of shard", "disk", "shard", (0.5, 2.0)),
    FaultKind("full disk of vehicle", "disk", "vehicle", (0.5, 2.0)),
    FaultKind("damaged pages", "page", "", (0.5, 3.0)),
    FaultKind("damaged pages, cold", "page", "worker", (2.0, 5.0)),
    FaultKind("clock step", "clock", "", (0.5, 3.0)),
    FaultKind("twice", "message", ""),
    FaultKind("out of order", "message", ""),
)
BY_NAME: Final = {kind.name: kind for kind in KINDS}
STEP_S: Final = (1.5, 2.5)
CLOCK_STEPS_S: Final = (1.0, 60.0, 3_600.0, 86_400.0, 40 * 86_400.0)


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault.

    Attributes:
        number: from 0.
        kind: name of a `FaultKind`.
        at_s: after the first report was merged, s.
        held_s: how long it lasts; 0: until the supervisor has started again what was killed.
        draw: in [0, 1): which of several parts, lines, pages.
        clock_s: by which the time of day is wrong.
    """

    number: int
    kind: str
    at_s: float
    held_s: float
    draw: float
    clock_s: float = 0.0

    @property
    def group(self) -> Group:
        """What is done."""
        return BY_NAME[self.kind].group

    @property
    def end_s(self) -> float:
        """When it is ended, s."""
        return self.at_s + self.held_s

    def as_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return asdict(self)


def plan(
    seed: int, count: int, kinds: tuple[FaultKind, ...] = KINDS, step_s: tuple[float, float] = STEP_S
) -> tuple[Fault, ...]:
    """The faults of a run: every kind about as often, in an order drawn, `step_s` apart; long ones overlap."""
    rng = random.Random(f"chaos {seed}")
    deck: list[FaultKind] = []
    faults: list[Fault] = []
    at_s = 0.0
    for number in range(count):
        if not deck:
            deck = rng.sample(kinds, len(kinds))
        kind = deck.pop()
        at_s += rng.uniform(*step_s)
        held_s = rng.uniform(*kind.held_s) if any(kind.held_s) else 0.0
        clock_s = rng.choice(CLOCK_STEPS_S) * rng.choice((-1, 1)) if kind.group == "clock" else 0.0
        faults.append(Fault(number, kind.name, round(at_s, 3), round(held_s, 3), rng.random(), clock_s))
    return tuple(faults)
