"""What is to become of a version on trial, by what vehicles tell: a pure function, with a bounded rate of false alarms.

Which vehicles get the version is drawn at random for each tile, so without harm done every split of the vehicles that
have spoken into those of the new version and those of the old one is equally likely: the Mann-Whitney test of their
scores is exact, whatever the scores are distributed like and however much vehicles, sensors and hours differ. It is
looked at once for each of `LOOKS`, when so many vehicles have spoken, each time with the same part of `FALSE_ALARM`, so
the rate holds over all looks together (Bonferroni). Scores must be worse by more than `MARGIN`: harm that does not
matter is no reason. The worst of the new version's vehicles is left out, so one alone withdraws nothing.

A vehicle that took the version and was not heard of again counts, too: Fisher's exact test of the silent in both arms.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from statistics import median
from typing import Any, Final, Literal

from gnd.tile_store.trials import VehicleHealth, VersionTrial

Decision = Literal["wait", "release", "withdraw"]

FALSE_ALARM: Final = 0.01
"""At most so many of the versions that do no harm are withdrawn."""
LOOKS: Final = ((4, 18), (6, 8), (9, 5), (13, 4), (19, 3), (28, 3))
"""Vehicles on the new version and on the old one: with fewer on the old one no scores would reach the level."""
ENOUGH: Final = 8
"""Vehicles on either version, of which no more than so many are waited for."""
FEWEST: Final = 4
"""Fewer vehicles of an arm say nothing about it."""
MARGIN: Final = 0.02
"""Of the score."""
SILENT_S: Final = 1800.0
"""A vehicle that took a version so long ago and has told nothing is silent."""
TROUBLE_WEIGHT: Final = 1.0
"""A visit in which every scan was in trouble is as bad as one in which nothing fitted."""
LEAST_SCANS: Final = 3
"""Scans that a vehicle must have looked at, or have been inside for, to have a score."""


@dataclass(frozen=True, slots=True)
class ArmFigures:
    """One arm: vehicles that spoke, their median score, matching ratio and share of scans in trouble; the silent."""

    told: int
    score: float | None
    matched: float | None
    trouble: float | None
    silent: int
    waiting: int


@dataclass(frozen=True, slots=True)
class LooksTaken:
    """How many of `LOOKS` each test has taken, and the p of its last one (1: it has taken none)."""

    worse: int = 0
    silent: int = 0
    p_worse: float = 1.0
    p_silent: float = 1.0


@dataclass(frozen=True, slots=True)
class Judgement:
    """What is to become of a version, why, and the figures behind it."""

    decision: Decision
    why: str
    new: ArmFigures
    old: ArmFigures
    looks: LooksTaken

    def as_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return asdict(self)


def score_of(told: VehicleHealth) -> float | None:
    """How a vehicle fares in the tile: its fit there beside its own elsewhere, less the share of scans in trouble.

    None: it has seen too little.
    """
    if max(told.scans, told.inside) < LEAST_SCANS:
        return None
    trouble = TROUBLE_WEIGHT * _trouble(told)
    if told.scans < LEAST_SCANS:  # it was lost in there, and could look at nothing
        return -trouble
    return (told.fit - told.elsewhere) / 1000.0 - trouble


def _trouble(told: VehicleHealth) -> float:
    return max(told.gated, told.not_good) / told.inside if told.inside else 0.0


def judged(trial: VersionTrial, said: Sequence[VehicleHealth], now_ns: int, before: LooksTaken) -> Judgement:
    """Decide, from what each vehicle has told until now.

    Args:
        trial: an open one that is not paused.
        said: of both arms, a row a vehicle.
        now_ns: int ns UTC.
        before: the looks that were taken; each is taken once.
    """
    arms = {arm: [one for one in said if one.arm == arm] for arm in ("new", "old")}
    scores = {arm: sorted(s for one in rows if (s := score_of(one)) is not None) for arm, rows in arms.items()}
    silent = {arm: sum(_is_silent(one, now_ns) for one in rows) for arm, rows in arms.items()}
    new, old = (_figures(arms[arm], scores[arm], silent[arm]) for arm in ("new", "old"))
    looks = _looked(before, scores, (new, old))
    decision, why = _decided(trial, (new, old), scores, looks, now_ns)
    return Judgement(decision, why, new, old, looks)


def _looked(before: LooksTaken, scores: dict[str, list[float]], arms: tuple[ArmFigures, ArmFigures]) -> LooksTaken:
    """Take the looks that are due now: of each test the last one, which those before it are part of."""
    new, old = arms
    looks = before
    due = _due(len(scores["new"]), len(scores["old"]))
    if due > before.worse:
        looks = replace(looks, worse=due, p_worse=_p_worse(scores["new"], scores["old"]))
    due = _due(new.told + new.silent, old.told + old.silent)
    if due > before.silent:
        looks = replace(looks, silent=due, p_silent=_p_silent((new.silent, new.told), (old.silent, old.told)))
    return looks


def _due(new: int, old: int) -> int:
    return sum(new >= of_new and old >= of_old for of_new, of_old in LOOKS)


def _decided(
    trial: VersionTrial,
    arms: tuple[ArmFigures, ArmFigures],
    scores: dict[str, list[float]],
    looks: LooksTaken,
    now_ns: int,
) -> tuple[Decision, str]:
    new, old = arms
    level = level_of_a_look()
    if looks.p_worse <= level:
        told = f"{new.told} vehicles fare worse on it than {old.told} on the one before"
        return "withdraw", f"{told}, p = {looks.p_worse:.2g}"
    if looks.p_silent <= level:
        heard = new.silent + new.told
        return "withdraw", f"{new.silent} of {heard} vehicles on it fell silent, p = {looks.p_silent:.2g}"
    is_over = now_ns - trial.since_ns >= trial.longest_ns
    if min(new.told, old.told) < FEWEST:
        if not is_over:
            return "wait", f"{new.told} and {old.told} vehicles have spoken, {FEWEST} of each are needed"
        if _is_quieter(new, old):
            return "wait", f"{new.silent} vehicles on it fell silent: somebody has to look"
        return "release", f"only {new.told} vehicles have tried it for {trial.longest_ns / 3.6e12:.3g} h"
    if _is_quieter(new, old):
        return "wait", f"{new.silent} of {new.silent + new.told} vehicles on it are silent, before it {old.silent}"
    # one alone releases nothing, and (when the time is over) holds nothing
    gap = median(scores["new"][1:] if is_over else scores["new"][:-1]) - median(scores["old"])
    if gap < -MARGIN:
        return "wait", f"{new.told} vehicles seem to fare worse on it by {-gap:.3f}, which may be chance"
    if is_over or min(new.told, old.told) >= ENOUGH:
        return "release", f"{new.told} vehicles fare no worse on it than {old.told} on the one before ({gap:+.3f})"
    return "wait", f"{new.told} and {old.told} vehicles have spoken, {ENOUGH} of each are enough"


def level_of_a_look() -> float:
    """The level of each of the two tests at each look."""
    return FALSE_ALARM / (2 * len(LOOKS))


def _p_worse(new: Sequence[float], old: Sequence[float]) -> float:
    """One-sided p that the scores of the new version are the lower ones by more than the margin, the worst of them
    left out; both sorted.
    """
    from scipy.stats import mannwhitneyu  # here because the import is dear, and only trials need it

    moved = [score + MARGIN for score in new[1:]]  # ties beyond the margin count as no harm: exact, or less
    apart = _without_ties(moved, old)
    return float(mannwhitneyu(*apart, alternative="less", method="exact").pvalue)


def _without_ties(new: Sequence[float], old: Sequence[float]) -> tuple[list[int], list[int]]:
    """Ranks of both; of equal scores the new version's counts as the better one."""
    order = sorted([(score, 1, k) for k, score in enumerate(new)] + [(score, 0, k) for k, score in enumerate(old)])
    ranks = {(arm, k): rank for rank, (_, arm, k) in enumerate(order)}
    return [ranks[1, k] for k in range(len(new))], [ranks[0, k] for k in range(len(old))]


def _p_silent(new: tuple[int, int], old: tuple[int, int]) -> float:
    """One-sided p that vehicles on the new version fall silent more often; (silent, told) of each arm."""
    silent, told = new[0] - 1, new[1] + 1  # one alone withdraws nothing
    if silent < 1:
        return 1.0
    from scipy.stats import fisher_exact

    return float(fisher_exact([[silent, told], list(old)], alternative="greater").pvalue)


def _is_quieter(new: ArmFigures, old: ArmFigures) -> bool:
    """Whether a good part of the vehicles on the new version are silent, and not on the old one; one alone is not."""
    heard_new, heard_old = new.told + new.silent, old.told + old.silent
    if new.silent < 2:
        return False
    return new.silent / heard_new - (old.silent / heard_old if heard_old else 0.0) > 0.25


def _is_silent(told: VehicleHealth, now_ns: int) -> bool:
    spoke = told.scans > 0 or told.inside > 0 or told.has_left
    return not spoke and now_ns - told.first_ns >= SILENT_S * 1e9


def _figures(rows: Sequence[VehicleHealth], scores: Sequence[float], silent: int) -> ArmFigures:
    seen = [one for one in rows if score_of(one) is not None]
    waiting = len(rows) - len(seen) - silent
    if not seen:
        return ArmFigures(0, None, None, None, silent, waiting)
    matched = [one.matched / 1000.0 for one in seen if one.scans >= LEAST_SCANS]
    return ArmFigures(
        told=len(seen),
        score=round(median(scores), 4),
        matched=round(median(matched), 4) if matched else None,
        trouble=round(median(map(_trouble, seen)), 4),
        silent=silent,
        waiting=waiting,
    )
