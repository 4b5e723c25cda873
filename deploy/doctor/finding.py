"""One line of `gnd doctor`."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Final, Literal

State = Literal["ok", "warning", "fault"]
WORST: Final[tuple[State, ...]] = ("fault", "warning", "ok")


@dataclass(frozen=True, slots=True)
class Finding:
    """What was looked at, and how it is.

    Attributes:
        what: was looked at.
        state: "fault": something will not work; "warning": it works, but badly or not for long.
        says: how it is, with figures.
        do: what to do about it; "" where all is well.
    """

    what: str
    state: State
    says: str
    do: str = ""

    def __post_init__(self) -> None:
        """Whoever complains says what to do."""
        if (self.state == "ok") == bool(self.do):
            raise ValueError(f"{self.what}: a finding that is {self.state} and says to do {self.do!r}")

    def as_dict(self) -> dict[str, str]:
        """JSON-able."""
        return asdict(self)


def worst(findings: Iterable[Finding]) -> State:
    """The worst state of all; "ok" of none."""
    states = {one.state for one in findings}
    return next((state for state in WORST if state in states), "ok")


def graded(what: str, value: float, limits: tuple[float, float], says: str, do: str) -> Finding:
    """A value that should be large: below the first limit a warning, below the second a fault."""
    if value >= limits[0]:
        return Finding(what, "ok", says)
    return Finding(what, "warning" if value >= limits[1] else "fault", says, do)
