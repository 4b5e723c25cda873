"""The vehicles of which a version says how they counted, each as a word of its basis.

A word is the name of a vehicle, alone or behind a mark; names begin with a letter or a digit, and hold no mark.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

from gnd.tile_store.values import QUARANTINED

CONTRADICTED: Final = "?"
"""Others contradict it elsewhere: what it alone claims waits."""
OVER_CAP: Final = "%"
"""`%DAY=VEHICLE`: on that day it has changed so much alone that the rest waits."""
GROUPED: Final = "&"
"""`&FIRST=VEHICLE`: it says the same false things as others, of whom FIRST comes first by name: they have one vote."""
_OF: Final = "="


def contradicted(vehicle: str) -> str:
    """The word for a vehicle that is not believed alone."""
    return CONTRADICTED + vehicle


def over_cap(vehicle: str, day: int) -> str:
    """The word for a vehicle that has changed much alone on a day, in days since 1970."""
    return f"{OVER_CAP}{day}{_OF}{vehicle}"


def grouped(vehicle: str, first: str) -> str:
    """The word for a vehicle of a group."""
    return f"{GROUPED}{first}{_OF}{vehicle}"


def renamed(word: str, vehicle: str, name: str) -> str:
    """The word with another name for a vehicle."""
    mark = word[:1] if word[:1] in (QUARANTINED, CONTRADICTED, OVER_CAP, GROUPED) else ""
    parts = word[len(mark) :].split(_OF)
    kept = parts[:1] if mark == OVER_CAP else []  # a day is no vehicle
    return mark + _OF.join([*kept, *(name if part == vehicle else part for part in parts[len(kept) :])])


@dataclass(frozen=True, slots=True)
class Marked:
    """What the words of a version say.

    Attributes:
        shifted: vehicles whose reports are shifted again and again, or that are behind a version that was withdrawn.
        counted_out: whose reports do not count.
        contradicted: that are not believed alone.
        over_cap: that are not believed alone on a day, and which.
        first_of: of each vehicle of a group the one that comes first by name.
    """

    shifted: frozenset[str] = frozenset()
    counted_out: frozenset[str] = frozenset()
    contradicted: frozenset[str] = frozenset()
    over_cap: frozenset[tuple[str, int]] = frozenset()
    first_of: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, words: Iterable[str]) -> "Marked":
        """Read them."""
        plain, behind = set[str](), {QUARANTINED: set[str](), CONTRADICTED: set[str]()}
        days, first_of = set[tuple[str, int]](), dict[str, str]()
        for word in sorted(words):
            mark, rest = word[:1], word[1:]
            if mark in behind:
                behind[mark].add(rest)
            elif mark == OVER_CAP:
                day, _, vehicle = rest.partition(_OF)
                days.add((vehicle, int(day)))
            elif mark == GROUPED:
                first, _, vehicle = rest.partition(_OF)
                first_of[vehicle] = first
            else:
                plain.add(word)
        return cls(
            frozenset(plain),
            frozenset(behind[QUARANTINED]),
            frozenset(behind[CONTRADICTED]),
            frozenset(days),
            first_of,
        )
