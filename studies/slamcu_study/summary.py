"""A finished study as plain values: the JSON of `gnd reproduce slamcu`."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.config import to_mapping
from studies.feature_study.averages import distances_plain, mean_over, rounded, std_over
from studies.feature_study.matching import RADIUS_M
from studies.feature_study.targets import judged
from studies.slamcu_study import reference
from studies.slamcu_study.outcome import MergedSigns, SeedOutcome, StudyOutcome
from studies.slamcu_study.scores import SignScore, accuracy_of, score
from studies.slamcu_study.verdicts import DELETED, NEW, NORMAL, SignTruth, Verdicts

LOST_M: Final = 5.0
"""Farther off than this a vehicle that claims to know better is lost: a lane and a half."""
LOST_CHI2: Final = 13.8
LOST_LOOKS: Final = 75
"""Five seconds at 15 Hz."""


def summary_of(outcome: StudyOutcome) -> dict[str, Any]:
    """Return everything as plain values: means over the seeds below `slamcu`, their standard deviations below
    `std_over_seeds`, each seed below `seeds`.
    """
    seeds = {str(one.seed): seed_summary(one) for one in outcome.seeds}
    mean = mean_over(list(seeds.values()))
    paper = {
        "accuracy": reference.PAPER_ACCURACY,
        "confusion": reference.PAPER_CONFUSION,
        "position_error_m": reference.PAPER_POSITION_M,
        "step_ms_mean": reference.PAPER_STEP_MS,
    }
    found = {
        "slamcu": mean,
        **worst_of(seeds),
        "std_over_seeds": std_over(list(seeds.values())),
        "targets": judged(mean, reference.TARGETS),
        "paper": paper,
        "seeds": seeds,
        "matching_radius_m": RADIUS_M,
        "classes": {"true": list(reference.TRUE_CLASSES), "predicted": list(reference.PREDICTED)},
        "parameters": to_mapping(outcome.options),
        "runtime_s": dict(outcome.runtime_s),
    }
    return dict(rounded(found))


def seed_summary(outcome: SeedOutcome) -> dict[str, Any]:
    """Return the numbers of one route."""
    truth = outcome.truth
    found = drive_summary(outcome.first, truth)
    found["all_drives"] = _of_all([scored_drive(drive, truth) for drive in outcome.drives])
    for vehicles, merged in outcome.merged.items():
        scored = merged_score(merged, truth)
        found[f"position_error_{vehicles}_m"] = scored.plain_errors() | {"nees": _nees(scored)}
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
        "position_error_m": scored.plain_errors() | parts_of_errors(scored, found) | {"nees": _nees(scored)},
        "false_new": {"all": len(scored.false_new), "near_a_sign_of_the_map": scored.near_known},
        "step_ms_median": float(np.median(found.step_ms)),
        "step_ms_p95": float(np.quantile(found.step_ms, 0.95)),
        "steps": len(found.step_ms),
        "pose_rmse": _pose_rmse(found),
        "pose_nees": float(found.pose_chi2.mean()),
        "lost": _lost(found),
        "lost_without_knowing": lost_without_knowing(found),
        "conflict": _conflict(found),
        "looks": {
            "visible": int(found.visible.sum()),
            "occluded": int(found.occluded.sum()),
            "no_evidence": int(found.no_evidence),
            "signs_never_visible": int(np.count_nonzero(found.visible == 0)),
            "new_signs_never_visible": int(np.count_nonzero(found.visible[truth.of(NEW)] == 0)),
        },
    }


def scored_new(found: Verdicts) -> tuple[F64, F64]:
    """Return positions and covariances of the new features that a drive says exist."""
    return found.new_xy_m[found.new_exists], found.new_cov_m2[found.new_exists]


def scored_drive(found: Verdicts, truth: SignTruth) -> SignScore:
    """Return how well a drive tells the signs."""
    return score(truth, (found.known_id, found.known_predicted), scored_new(found))


def merged_score(merged: MergedSigns, truth: SignTruth) -> SignScore:
    """Return how well a published layer tells the signs: what it holds exists, what it no longer holds is deleted."""
    ids = truth.feature_id[truth.true_class != NEW]
    said = np.where(np.isin(ids, merged.known_id), NORMAL, DELETED).astype(np.uint8)
    return score(truth, (ids, said), (merged.new_xy_m, merged.new_cov_m2))


def parts_of_errors(scored: SignScore, found: Verdicts) -> dict[str, Any]:
    """Return mean lengths of what the pose moved each new sign by, and of the rest, which is the measurements'."""
    pose = found.pose_part_m[scored.sign]
    rest = scored.error_m - pose
    seen = np.isfinite(pose).all(axis=1)
    return {f"{name}_part": _mean_length(part[seen]) for name, part in (("pose", pose), ("measurement", rest))}


def _mean_length(vectors: F64) -> float | None:
    return float(np.linalg.norm(vectors, axis=1).mean()) if len(vectors) else None


def _nees(scored: SignScore) -> dict[str, Any] | None:
    return None if scored.honesty is None else scored.honesty.plain()


def _pose_rmse(found: Verdicts) -> dict[str, float]:
    along, across, heading = np.sqrt(np.mean(found.pose_error**2, axis=0))
    return {"longitudinal_m": float(along), "lateral_m": float(across), "heading_deg": float(np.degrees(heading))}


def lost_without_knowing(found: Verdicts) -> int:
    """Return on how many stretches of `LOST_LOOKS` looks or more the vehicle was `LOST_M` off, far beyond what it
    claims (χ² of 2 degrees of freedom, 99.9 %), and does not say that it was lost.

    Poses are those that it believes in at the end, which its reports rest on.
    """
    off = np.hypot(*found.pose_error[:, :2].T) > LOST_M
    wrong = off & (found.pose_chi2 > LOST_CHI2) & ~found.pose_said_lost
    edges = np.flatnonzero(np.diff(np.concatenate([[False], wrong, [False]]).astype(np.int8)))
    return int(np.count_nonzero(edges[1::2] - edges[::2] >= LOST_LOOKS))


def _lost(found: Verdicts) -> dict[str, float]:
    """What the vehicle itself says of where it was lost: stretches, of these told anew, and what it took back."""
    stretches = {"stretches": len(found.lost), "told_anew": float(found.lost[:, 5].sum())}
    return stretches | {
        "off_m_max": float(found.lost[:, 2].max(initial=0.0)),
        "seconds": float((found.lost[:, 1] - found.lost[:, 0]).sum()),
        "taken_back": float(found.lost[:, 4].sum()),
        "share_given_up": float(found.pose_said_lost.mean()),
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


def _conflict(found: Verdicts) -> dict[str, float]:
    """How much was thrown away by Dempster's normalisation, over the signs of the map and the new features."""
    conflict = np.concatenate([found.known_conflict, found.new_conflict])
    if not len(conflict):
        return {}
    return {
        "mean": float(conflict.mean()),
        "p95": float(np.quantile(conflict, 0.95)),
        "max": float(conflict.max()),
        "share_above_half": float(np.mean(conflict > 0.5)),
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
