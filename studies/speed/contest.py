"""How a race is run: every entrant once a round, each round begun by another, and ratios within a round."""

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import process_time
from typing import Any

from studies.frame.tables import Sheet


@dataclass(frozen=True, slots=True)
class Entrant:
    """Somebody who does the work.

    Attributes:
        name: as it stands in the table.
        work: does all of it once, from prepared input.
        judge: says in a few words how good what `work` returned is.
    """

    name: str
    work: Callable[[], Any]
    judge: Callable[[Any], str]


@dataclass(frozen=True, slots=True)
class Absent:
    """A peer that cannot run here, and why."""

    name: str
    why: str


@dataclass(frozen=True, slots=True)
class Contest:
    """One work and those who do it.

    Attributes:
        title: what the work is.
        unit: what a time is told for: "ms/scan".
        units: how many of these one call of `work` does.
        ours: the first row; all ratios are to it.
        others: the other rows.
        notes: what one must know to read the table, one sentence each.
    """

    title: str
    unit: str
    units: float
    ours: Entrant
    others: Sequence[Entrant | Absent]
    notes: Sequence[str] = ()


def raced(contest: Contest, rounds: int) -> Sheet:
    """Run a contest; the table of medians, spreads, ratios and results.

    Times are the processor's, of all threads of the process. One call of each is made before, for caches and compilers;
    it is the one that is judged.
    """
    runners = [contest.ours, *(one for one in contest.others if isinstance(one, Entrant))]
    results = {one.name: one.judge(one.work()) for one in runners}
    taken_ms = times_ms(runners, rounds, contest.units)
    ours_ms = taken_ms[contest.ours.name]
    table = Sheet(contest.title, ("", contest.unit, "fastest to slowest", "times ours", "result"), texts=("result",))
    for one in [contest.ours, *contest.others]:
        if isinstance(one, Absent):
            table.add(one.name, "not run", "", "", one.why, style="dim")
            continue
        own_ms = taken_ms[one.name]
        ratios = sorted(own / ours for own, ours in zip(own_ms, ours_ms, strict=True))
        ratio = (
            f"{statistics.median(ratios):.2f} ({ratios[0]:.2f} to {ratios[-1]:.2f})" if one is not runners[0] else "1"
        )
        spread = f"{min(own_ms):.3g} to {max(own_ms):.3g}"
        table.add(one.name, f"{statistics.median(own_ms):.3g}", spread, ratio, results[one.name])
    table.notes += contest.notes
    return table


def times_ms(runners: Sequence[Entrant], rounds: int, units: float) -> dict[str, list[float]]:
    """Milliseconds of the processor a unit, by name, one a round."""
    taken_ms: dict[str, list[float]] = {one.name: [] for one in runners}
    for number in range(rounds):
        first = number % len(runners)
        for one in [*runners[first:], *runners[:first]]:
            begin_s = process_time()
            one.work()
            taken_ms[one.name].append(1e3 * (process_time() - begin_s) / units)
    return taken_ms
