"""The figures of the SLAMCU paper on our routes: masses over time (Figure 8), position errors (Figure 9)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from gnd.gnd_map.arrays import F64, I64
from gnd.picture_style import BLUE, GREY, INK, MAGENTA, ORANGE, RED
from studies.frame.figures import dress, finish, new_figure
from studies.slamcu_study import signs as reference
from studies.slamcu_study.scores import SignScore, merged_score, scored_drive
from studies.slamcu_study.signs import ABSENT, DELETED, EXIST, NEW, SignTruth, SlamcuSeed, Verdicts

_MASSES: Final = (("m(∃) exists", BLUE), ("m(∄) does not", RED), ("m(Ω) unknown", GREY))
_SHOWN_STEPS: Final = 30


def draw_figures(outcomes: Sequence[SlamcuSeed], km: float, folder: Path) -> list[Path]:
    """Draw all figures into the folder and return their paths; of single signs those of the first route.

    Raises:
        SimError: a file cannot be written.
    """
    first = outcomes[0]
    note = f"seed {first.seed}, {km:g} km of motorway"
    return [
        draw_masses(first.first, first.truth, note, folder / "slamcu_masses.png"),
        draw_positions(first, note, folder / "slamcu_position_errors.png"),
    ]


def draw_masses(found: Verdicts, truth: SignTruth, note: str, path: Path) -> Path:
    """Draw Figure 8: masses of one deleted and one new sign, those with an outlier, over the looks that counted."""
    figure = new_figure(9.6, 6.4)
    panels = figure.subplots(2, 1, sharey=True)
    cases = ((DELETED, "a deleted sign of the map"), (NEW, "a new sign"))
    for axes, (true_class, name) in zip(panels, cases, strict=True):
        dress(axes, "", "mass", name)
        sign = most_telling(found, truth.of(true_class), ABSENT if true_class == DELETED else EXIST)
        if sign is not None:
            masses = found.trace_masses[found.trace_sign == sign][:_SHOWN_STEPS]
            _mass_lines(axes, masses, EXIST if true_class == DELETED else ABSENT)
        axes.set_ylim(-0.03, 1.06)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    panels[0].legend(loc="center right", fontsize=9, framealpha=0.9)
    panels[1].set_xlabel("look that gave evidence", color=INK)
    lambdas = f"λ = {reference.PAPER_LAMBDA}, λ_HD = {reference.PAPER_LAMBDA_HD}"
    return finish(figure, "Masses over time", f"{note}; {lambdas}; outliers in orange", path)


def _mass_lines(axes: Axes, masses: F64, against: int) -> None:
    steps = np.arange(len(masses))
    for step in outliers(masses, against):
        axes.axvline(step, color=ORANGE, linewidth=5.0, alpha=0.35)
    for column, (label, colour) in enumerate(_MASSES):
        axes.plot(steps, masses[:, column], "o-", color=colour, linewidth=1.9, markersize=4, label=label)


def outliers(masses: F64, against: int) -> I64:
    """Return the steps of masses (Q, >= 3) at which a look spoke for the wrong state: that mass has grown."""
    return np.flatnonzero(np.diff(masses[:, against]) > 1e-9).astype(np.int64) + 1


def most_telling(found: Verdicts, signs: I64, right: int) -> int | None:
    """Return, of the signs (N,) that soon come to the right state, the one in which an outlier shows most; None where
    no sign has a trace.
    """
    wrong = EXIST if right == ABSENT else ABSENT
    best: tuple[tuple[bool, float], int] | None = None
    for sign in signs.tolist():
        masses = found.trace_masses[found.trace_sign == sign][:_SHOWN_STEPS]
        if len(masses) < 2:
            continue
        grown = float(np.diff(masses[:, wrong]).max(initial=0.0))
        rank = (bool(masses[-1].argmax() != right), -grown)
        if best is None or rank < best[0]:
            best = (rank, sign)
    return None if best is None else best[1]


def draw_positions(outcome: SlamcuSeed, note: str, path: Path) -> Path:
    """Draw Figure 9: the position error of each new sign, with mean and standard deviation; merged ones as dots."""
    truth = outcome.truth
    one, merged = scored_drive(outcome.first, truth), max(outcome.merged, default=None)
    figure = new_figure(11.0, 5.0)
    axes, side = figure.subplots(1, 2, width_ratios=(4.2, 1))
    dress(axes, "new sign along the route", "position error, m")
    number = {sign: i + 1 for i, sign in enumerate(truth.of(NEW).tolist())}
    axes.bar([number[s] for s in one.sign.tolist()], one.distance_m, color=BLUE, width=0.7, label="one drive")
    scores: list[tuple[str, str, SignScore]] = [("one drive", BLUE, one)]
    if merged is not None:
        of_all = merged_score(outcome.merged[merged], truth)
        name = f"{merged} vehicles"
        axes.plot([number[s] for s in of_all.sign.tolist()], of_all.distance_m, "o", color=MAGENTA, label=name)
        scores.append((name, MAGENTA, of_all))
    _missed(axes, [n for sign, n in number.items() if sign not in set(one.sign.tolist())])
    mean = reference.PAPER_POSITION_M["mean"]
    axes.axhline(mean, color=ORANGE, linestyle="--", label=f"paper's mean, {mean:g} m")
    axes.legend(fontsize=9, ncols=4, loc="upper right")
    axes.set_ylim(0.0, 1.25 * max([2.0, *one.distance_m.tolist()]))
    _means(side, scores)
    return finish(figure, "Position error of new signs", f"{note}; ×: not found by the one drive", path)


def _missed(axes: Axes, numbers: Sequence[int]) -> None:
    axes.plot(numbers, [0.06] * len(numbers), "x", color=RED, markersize=7, markeredgewidth=2)


def _means(axes: Axes, scores: Sequence[tuple[str, str, SignScore]]) -> None:
    """Bars of means with standard deviations, the paper's last."""
    dress(axes, "", "mean ± standard deviation, m")
    paper = (reference.PAPER_POSITION_M["mean"], reference.PAPER_POSITION_M["std"])
    bars = [(name, colour, _moments(scored)) for name, colour, scored in scores] + [("paper", ORANGE, paper)]
    for i, (_, colour, (mean, std)) in enumerate(bars):
        axes.bar(i, mean, yerr=std, color=colour, width=0.65, capsize=4, ecolor=INK)
        axes.text(i + 0.06, mean + 0.02, f" {mean:.2f}", color=INK, fontsize=9, va="bottom")
    axes.set_xticks(range(len(bars)), [name.replace(" ", "\n") for name, *_ in bars])
    axes.set_ylim(bottom=0.0)


def _moments(scored: SignScore) -> tuple[float, float]:
    distance = scored.distance_m
    return (float(distance.mean()), float(distance.std())) if len(distance) else (0.0, 0.0)
