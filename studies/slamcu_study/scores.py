"""Table 1 and Figure 9 of the SLAMCU paper: how signs were classified, how far off the new ones are; as tables, too."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.config import to_mapping
from studies.feature_study.truth import RADIUS_M, Honesty, Matching, match_one_to_one
from studies.frame.averages import distances_plain, mean_over, rounded, std_over
from studies.frame.tables import Sheet, fixed, seeds_named, sheet, sheet_of, shown
from studies.frame.targets import judged, targets_sheet
from studies.slamcu_study.signs import (
    DELETED,
    NEW,
    NORMAL,
    PAPER_ACCURACY,
    PAPER_CONFUSION,
    PAPER_POSITION_M,
    PAPER_STEP_MS,
    PREDICTED,
    TARGETS,
    TRUE_CLASSES,
    U8,
    VARIANTS,
    MeasuredSigns,
    MergedSigns,
    SignTruth,
    SlamcuSeed,
    Verdicts,
)  # fmt: skip

UNCLASSIFIED = PREDICTED.index("unclassified")


@dataclass(frozen=True, slots=True, eq=False)
class SignScore:
    """How well signs were classified and placed.

    Attributes:
        confusion: int64 (3, 4), rows `TRUE_CLASSES`, columns `PREDICTED`.
        sign: int64 (P,), indices of the new signs that were found.
        error_m: float64 (P, 2), estimated minus true position, map frame.
        estimate: int64 (P,), index of each one's estimate.
        honesty: of the P covariances.
        false_new: int64, indices of estimates without a new sign.
        near_known: how many of these lie within the radius of a sign of the map.
    """

    confusion: I64
    sign: I64
    error_m: F64
    estimate: I64
    honesty: Honesty | None
    false_new: I64
    near_known: int

    @property
    def distance_m(self) -> F64:
        """(P,) errors."""
        return np.asarray(np.linalg.norm(self.error_m, axis=1))

    def plain_errors(self) -> dict[str, Any]:
        """Return mean, standard deviation and more of the errors, and what was missed or false."""
        return distances_plain(self.distance_m) | {"missed": self.missed, "false": len(self.false_new)}

    @property
    def missed(self) -> int:
        """New signs without an estimate."""
        return int(self.confusion[NEW].sum()) - len(self.sign)


def score(
    truth: SignTruth,
    known: tuple[I64, U8],
    new: tuple[F64, F64],
    radius_m: float = RADIUS_M,
) -> SignScore:
    """Return how well a drive, or a map, classifies and places the signs.

    Args:
        truth: all signs of the route.
        known: feature ids (K,) of the signs of the map that was driven with, and their classes (K,), indices of
            `PREDICTED`.
        new: positions (J, 2) [m] and covariances (J, 2, 2) [m^2] of the new features that are reported.
        radius_m: the farthest an estimate may lie from its sign.
    """
    confusion = np.zeros((len(TRUE_CLASSES), len(PREDICTED)), np.int64)
    for true_class in (NORMAL, DELETED):
        predicted = _predicted(truth.feature_id[truth.of(true_class)], *known)
        confusion[true_class] = np.bincount(predicted, minlength=len(PREDICTED))
    signs, (xy_m, cov_m2) = truth.of(NEW), new
    matching = match_one_to_one(xy_m, truth.xy_m[signs], radius_m)
    confusion[NEW, PREDICTED.index("new")] = len(matching.true)
    confusion[NEW, UNCLASSIFIED] = len(matching.missed)
    return _placed(truth, confusion, matching, (signs, xy_m, cov_m2), radius_m)


def _placed(
    truth: SignTruth, confusion: I64, matching: Matching, new: tuple[I64, F64, F64], radius_m: float
) -> SignScore:
    signs, xy_m, cov_m2 = new
    sign = signs[matching.true]
    error_m = xy_m[matching.estimate] - truth.xy_m[sign]
    honesty = Honesty.of(error_m, cov_m2[matching.estimate])
    near = _near(xy_m[matching.false], truth.xy_m[truth.true_class != NEW], radius_m)
    return SignScore(confusion, sign, error_m, matching.estimate, honesty, matching.false, near)


def _predicted(feature_ids: I64, known_id: I64, predicted: U8) -> I64:
    """(N,) the class of signs of the map by the drive; unclassified what it does not mention."""
    by_id = dict(zip(known_id.tolist(), predicted.tolist(), strict=True))
    return np.array([by_id.get(one, UNCLASSIFIED) for one in feature_ids.tolist()], np.int64)


def _near(xy_m: F64, others_m: F64, radius_m: float) -> int:
    """How many of (N, 2) lie within the radius of one of (M, 2)."""
    apart = np.linalg.norm(xy_m[:, None, :] - others_m[None, :, :], axis=2)
    return int(np.count_nonzero((apart < radius_m).any(axis=1)))


def accuracy_of(confusion: I64 | F64) -> dict[str, float | None]:
    """Return percent right of each class and of all; None of a class that the route has none of."""
    right, there = np.array([confusion[i, i] for i in range(len(TRUE_CLASSES))]), confusion.sum(axis=1)
    by_class = {name: 100.0 * float(right[i] / there[i]) if there[i] else None for i, name in enumerate(TRUE_CLASSES)}
    return by_class | {"overall": 100.0 * float(right.sum() / there.sum()) if there.sum() else None}


LOST_M: Final = 5.0
"""Farther off than this a vehicle that claims to know better is lost: a lane and a half."""
LOST_CHI2: Final = 13.8
LOST_LOOKS: Final = 75
"""Five seconds at 15 Hz."""


def summary_of(options: Any, outcomes: Sequence[SlamcuSeed], spent_s: Mapping[str, float]) -> dict[str, Any]:
    """Return everything as plain values: means over the seeds below `slamcu`, their standard deviations below
    `std_over_seeds`, each seed below `seeds`.
    """
    seeds = {str(one.seed): seed_summary(one) for one in outcomes}
    mean = mean_over(list(seeds.values()))
    paper = {
        "accuracy": PAPER_ACCURACY,
        "confusion": PAPER_CONFUSION,
        "position_error_m": PAPER_POSITION_M,
        "step_ms_mean": PAPER_STEP_MS,
    }
    found = {
        "slamcu": mean | distribution_of(seeds),
        **worst_of(seeds),
        "std_over_seeds": std_over(list(seeds.values())),
        "targets": judged(mean, TARGETS),
        "paper": paper,
        "seeds": seeds,
        "matching_radius_m": RADIUS_M,
        "classes": {"true": list(TRUE_CLASSES), "predicted": list(PREDICTED)},
        "parameters": to_mapping(options),
        "runtime_s": dict(spent_s),
    }
    return dict(rounded(found))


def seed_summary(outcome: SlamcuSeed) -> dict[str, Any]:
    """Return the numbers of one route."""
    truth = outcome.truth
    found = drive_summary(outcome.first, truth)
    found["all_drives"] = _of_all([scored_drive(drive, truth) for drive in outcome.drives])
    found["known_signs"] = known_plain(outcome.measured, truth)
    for vehicles, merged in outcome.merged.items():
        scored = merged_score(merged, truth)
        found[f"position_error_{vehicles}_m"] = scored.plain_errors() | {"nees": _nees(scored)}
        found[f"known_signs_{vehicles}"] = known_plain([merged.known], truth)
        found[f"accuracy_{vehicles}"] = accuracy_of(scored.confusion)
    found["ablation"] = {name: _ablation(one, truth) for name, one in outcome.variants.items()}
    return found


def drive_summary(found: Verdicts, truth: SignTruth) -> dict[str, Any]:
    """Return the numbers of one drive."""
    scored = scored_drive(found, truth)
    return {
        "accuracy": accuracy_of(scored.confusion),
        "accuracy_visible": accuracy_of(scored_drive(found, truth.take(found.visible > 0)).confusion),
        "confusion": scored.confusion.tolist(),
        "position_error_m": scored.plain_errors() | {"nees": _nees(scored)},
        "false_new": {"all": len(scored.false_new), "near_a_sign_of_the_map": scored.near_known},
        "step_ms_median": float(np.median(found.step_ms)),
        "step_ms_p95": float(np.quantile(found.step_ms, 0.95)),
        "steps": len(found.step_ms),
        "pose_rmse": _pose_rmse(found),
        "pose_nees": float(found.pose_chi2.mean()),
        "lost": _lost(found),
        "lost_without_knowing": lost_without_knowing(found),
        "looks": {
            "visible": int(found.visible.sum()),
            "occluded": int(found.occluded.sum()),
            "signs_never_visible": int(np.count_nonzero(found.visible == 0)),
            "new_signs_never_visible": int(np.count_nonzero(found.visible[truth.of(NEW)] == 0)),
        },
    }


def scored_drive(found: Verdicts, truth: SignTruth) -> SignScore:
    """Return how well a drive classifies and places the signs."""
    return score(truth, (found.known_id, found.known_predicted), (found.new_xy_m, found.new_cov_m2))


def merged_score(merged: MergedSigns, truth: SignTruth) -> SignScore:
    """Return how well a published layer has the signs: what it holds exists, what it no longer holds is deleted."""
    ids = truth.feature_id[truth.true_class != NEW]
    predicted = np.where(np.isin(ids, merged.known_id), NORMAL, DELETED).astype(np.uint8)
    return score(truth, (ids, predicted), (merged.new_xy_m, merged.new_cov_m2))


def known_plain(measured: Sequence[MeasuredSigns], truth: SignTruth) -> dict[str, Any]:
    """Return errors and NEES of signs that stand as mapped, as vehicles measured them or a map has them."""
    normal = truth.of(NORMAL)
    row = dict(zip(truth.feature_id[normal].tolist(), normal.tolist(), strict=True))
    errors, covs = [np.zeros((0, 2))], [np.zeros((0, 2, 2))]
    for one in measured:
        stands = np.isin(one.feature_id, truth.feature_id[normal])
        rows = np.array([row[number] for number in one.feature_id[stands].tolist()], np.int64)
        errors.append(one.xy_m[stands] - truth.xy_m[rows])
        covs.append(one.cov_m2[stands])
    error_m = np.concatenate(errors)
    honesty = Honesty.of(error_m, np.concatenate(covs))
    return distances_plain(np.hypot(*error_m.T)) | {"nees": None if honesty is None else honesty.plain()}


def _nees(scored: SignScore) -> dict[str, Any] | None:
    return None if scored.honesty is None else scored.honesty.plain()


def _pose_rmse(found: Verdicts) -> dict[str, float]:
    along, across, heading = np.sqrt(np.mean(found.pose_error**2, axis=0))
    return {"longitudinal_m": float(along), "lateral_m": float(across), "heading_deg": float(np.degrees(heading))}


def lost_without_knowing(found: Verdicts) -> int:
    """Return on how many stretches of `LOST_LOOKS` looks or more the vehicle was `LOST_M` off, far beyond what it
    claims (χ² of 2 degrees of freedom, 99.9 %), and has not given the stretch up.

    Poses are those that it believes in at the end, which its reports rest on.
    """
    off = np.hypot(*found.pose_error[:, :2].T) > LOST_M
    wrong = off & (found.pose_chi2 > LOST_CHI2) & ~found.pose_given_up
    edges = np.flatnonzero(np.diff(np.concatenate([[False], wrong, [False]]).astype(np.int8)))
    return int(np.count_nonzero(edges[1::2] - edges[::2] >= LOST_LOOKS))


def _lost(found: Verdicts) -> dict[str, float]:
    """Stretches on which the vehicle found itself lost, how many of them it estimated anew, and verdicts taken back."""
    stretches = {"stretches": len(found.lost), "told_anew": float(found.lost[:, 5].sum())}
    return stretches | {
        "off_m_max": float(found.lost[:, 2].max(initial=0.0)),
        "seconds": float((found.lost[:, 1] - found.lost[:, 0]).sum()),
        "taken_back": float(found.lost[:, 4].sum()),
        "share_given_up": float(found.pose_given_up.mean()),
    }


def worst_of(seeds: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the worst first drive: its accuracy, and how many drives were lost, knowing it or not."""
    by_seed = {seed: one["accuracy"]["overall"] for seed, one in seeds.items()}
    worst = min(by_seed, key=lambda seed: by_seed[seed])
    return {
        "worst": {"accuracy": by_seed[worst], "seed": int(worst)},
        "lost": sum(one["lost"]["stretches"] > 0 for one in seeds.values()),
        "lost_without_knowing": sum(one["lost_without_knowing"] > 0 for one in seeds.values()),
        "drives": len(seeds),
    }


def distribution_of(seeds: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return how the first drives of all seeds are distributed by the share of signs that are right (per cent), false
    new signs a drive over all drives, and how many first drives were lost without saying so.
    """
    right = np.array([one["accuracy"]["overall"] for one in seeds.values()])
    return {
        "distribution": {
            "mean": float(right.mean()),
            "median": float(np.median(right)),
            "p5": float(np.quantile(right, 0.05)),
            "worst": float(right.min()),
            "drives": len(right),
        },
        "false_new_per_drive": float(
            np.mean([one["all_drives"]["position_error_m"]["false_a_drive"] for one in seeds.values()])
        ),
        "lost_unnoticed": sum(one["lost_without_knowing"] > 0 for one in seeds.values()),
    }


def _of_all(scores: Sequence[SignScore]) -> dict[str, Any]:
    """Return the numbers of all drives together."""
    confusion = np.sum([one.confusion for one in scores], axis=0)
    errors = distances_plain(np.concatenate([one.distance_m for one in scores]))
    missed, false = sum(one.missed for one in scores), sum(len(one.false_new) for one in scores)
    counts = {"drives": len(scores), "missed_a_drive": missed / len(scores), "false_a_drive": false / len(scores)}
    return {"accuracy": accuracy_of(confusion), "position_error_m": errors | counts}


def _ablation(found: Verdicts, truth: SignTruth) -> Mapping[str, Any]:
    whole = drive_summary(found, truth)
    return {name: whole[name] for name in ("accuracy", "confusion", "position_error_m", "pose_rmse", "step_ms_median")}


Found = Mapping[str, Any]
_ERRORS: Final = {
    "mean": "{mean:.3f}", "± std": "{std:.3f}", "p95": "{p95:.3f}", "found": "{found:.4g}", "missed": "{missed:.4g}",
    "false": "{false:.4g}", "NEES (2)": "{nees.mean:.2f}",
}  # fmt: skip
_ABLATION: Final = {
    **{f"{name} %": f"{{accuracy.{name}:.2f}}" for name in (*TRUE_CLASSES, "overall")},
    "new signs, m": "{position_error_m.mean:.3f}",
    "missed": "{position_error_m.missed:.4g}",
    "false": "{position_error_m.false:.4g}",
    "pose along / across, m": "{pose_rmse.longitudinal_m:.2f} / {pose_rmse.lateral_m:.2f}",
}
_FACTS: Final = {
    "verdicts taken back a drive": "{lost.taken_back:.2f}",
    "NEES of the place (2 expected)": "{pose_nees:.2f}",
    "one step: median / 95 %": "{step_ms_median:.2f} / {step_ms_p95:.2f} ms",
    "looks at signs: visible / hidden": "{looks.visible:.0f} / {looks.occluded:.0f}",
    "signs never visible / new ones of them": "{looks.signs_never_visible:.4g} / {looks.new_signs_never_visible:.4g}",
    "NEES of new signs (2 expected) / within their 95 %": (
        "{position_error_m.nees.mean:.2f} / {position_error_m.nees.within_95:.0%}"
    ),
    "the same of signs as mapped": "{known_signs.nees.mean:.2f} / {known_signs.nees.within_95:.0%}",
}


def tables_of(found: Found) -> list[Sheet]:
    """Return all tables."""
    ours, seeds = found["slamcu"], seeds_named(list(found["seeds"]))
    rows = {VARIANTS[name]: row for name, row in ours["ablation"].items()}
    ablation = sheet_of("what matters: the first drive once more", _ABLATION, rows)
    targets = targets_sheet(found["targets"], f"targets, mean of {seeds}")
    whose = f"{seeds}, {found['parameters']['noise']} noise"
    return [_confusion(ours, whose), _positions(found, ours), ablation, _facts(found, ours), targets]


def _confusion(ours: Found, seeds: str) -> Sheet:
    """Table 1 in the paper's layout, the paper's numbers in brackets."""
    heads = (*(name.capitalize() for name in PREDICTED), "Accuracy", "Of those ever in free view")
    table = sheet(f"Table 1, mean of {seeds}; in brackets the paper's", "true \\ predicted", *heads)
    for i, name in enumerate((*TRUE_CLASSES, "overall")):
        pairs = zip(ours["confusion"][i], PAPER_CONFUSION[i], strict=True) if name in TRUE_CLASSES else ()
        cells = [f"{number:.4g} ({paper})" for number, paper in pairs] or [""] * len(PREDICTED)
        accuracy = f"{fixed(ours['accuracy'][name])} % ({PAPER_ACCURACY[name]:g} %)"
        table.add(name.capitalize(), *cells, accuracy, fixed(ours["accuracy_visible"][name], 2, " %"))
    return table


def _positions(found: Found, ours: Found) -> Sheet:
    """Figure 9 as numbers."""
    counts = sorted(int(name.split("_")[1]) for name in ours if name.startswith("accuracy_") and name[9:].isdecimal())
    rows = {f"{n} vehicles, merged": ours[f"position_error_{n}_m"] for n in counts}
    title = f"position error of new signs, m; pairs within {found['matching_radius_m']:g} m"
    table = sheet_of(title, _ERRORS, {"one drive": ours["position_error_m"]} | rows)
    table.add("paper, one drive", PAPER_POSITION_M["mean"], PAPER_POSITION_M["std"], "", 36, 3, style="dim")
    return table


def _facts(found: Found, ours: Found) -> Sheet:
    table = sheet("beside", "", "")
    spread = "{distribution.mean:.2f} / {distribution.median:.2f} / {distribution.p5:.2f} / {distribution.worst:.2f} %"
    table.add("right, first drives: mean / median / 5 % / worst", shown(spread, ours))
    table.add("false new signs a drive", shown("{false_new_per_drive:.2f}", ours))
    for name in ours:
        if name.startswith("accuracy_") and name[9:].isdecimal():
            table.add(f"right, {name[9:]} vehicles merged", shown(f"{{{name}.overall:.2f}} %", ours))
    table.add("worst first drive", shown("{worst.accuracy:.2f} % (seed {worst.seed})", found))
    table.add("drives that found they had been lost", shown("{lost} of {drives}", found))
    table.add("drives lost without knowing", shown("{lost_without_knowing} of {drives}", found))
    for name, cell in _FACTS.items():
        table.add(name, shown(cell, ours))
    return table
