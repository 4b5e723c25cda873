"""Table 1 and the position errors of the SLAMCU study, on cases made by hand."""

from pathlib import Path

import click
import numpy as np
import pytest

from studies.frame.errors import FolderError
from studies.frame.kept import Kept
from studies.frame.options import numbers
from studies.slamcu_study.figures import most_telling, outliers
from studies.slamcu_study.scores import (
    UNCLASSIFIED,
    accuracy_of,
    distribution_of,
    drive_summary,
    known_plain,
    lost_without_knowing,
    merged_score,
    score,
    scored_drive,
    worst_of,
)
from studies.slamcu_study.signs import (
    ABSENT,
    DELETED,
    EXIST,
    NEW,
    NORMAL,
    PAPER_ACCURACY,
    PAPER_CONFUSION,
    MeasuredSigns,
    MergedSigns,
    SignTruth,
    Verdicts,
)

TRUTH = SignTruth(
    np.arange(1, 8),
    np.array([[0, 0], [10, 0], [20, 0], [30, 0], [40, 0], [41, 0], [90, 0]], np.float64),
    np.array([NORMAL, NORMAL, DELETED, DELETED, NEW, NEW, NEW], np.uint8),
)
EXISTS, GONE = [0.9, 0.05, 0.05], [0.0, 0.99, 0.01]
STEPS = np.tile([1.0, -0.5, 0.01], (3, 1))


def verdicts(**changes: object) -> Verdicts:
    """Sign 1 right, 2 called deleted, 3 deleted, 4 never decided; two of three new ones, one false."""
    columns: dict[str, object] = {
        "known_id": np.array([1, 2, 3, 4]),
        "known_predicted": np.array([NORMAL, DELETED, DELETED, UNCLASSIFIED], np.uint8),
        "new_xy_m": np.array([[40.3, 0.4], [41.0, 0.1], [10.5, 0.0]]),
        "new_cov_m2": np.broadcast_to(0.04 * np.eye(2), (3, 2, 2)),
        "step_ms": np.array([1.0, 2.0, 9.0]),
        "pose_error": STEPS,
        "pose_chi2": np.array([1.0, 2.0, 3.0]),
        "pose_given_up": np.zeros(3, np.bool_),
        "lost": np.array([[10.0, 40.0, 7.5, 5.6, 3.0, 1.0]]),
        "visible": np.array([9, 9, 9, 0, 9, 9, 0]),
        "occluded": np.array([1, 0, 0, 4, 0, 0, 2]),
        "trace_sign": np.array([2, 2, 2, 2, 4, 4]),
        "trace_masses": np.array([[.95, 0, .05], [.6, .37, .03], [.9, .08, .02], GONE, [0, 0, 1], EXISTS]),
    }  # fmt: skip
    return Verdicts(**{**columns, **changes})  # type: ignore[arg-type]


def test_every_sign_of_the_route_is_in_the_table() -> None:
    scored = scored_drive(verdicts(), TRUTH)
    assert scored.confusion.tolist() == [[1, 1, 0, 0], [0, 1, 0, 1], [0, 0, 2, 1]]
    assert scored.confusion.sum() == len(TRUTH.feature_id)
    assert scored.sign.tolist() == [4, 5]
    assert scored.distance_m == pytest.approx([0.5, 0.1])
    assert scored.false_new.tolist() == [2]
    assert scored.near_known == 1
    assert accuracy_of(scored.confusion) == pytest.approx(
        {"normal": 50.0, "deleted": 50.0, "new": 200 / 3, "overall": 100 * 4 / 7}
    )


def test_new_signs_that_no_report_mentions_are_missed() -> None:
    summary = drive_summary(verdicts(new_xy_m=np.zeros((0, 2)), new_cov_m2=np.zeros((0, 2, 2))), TRUTH)
    assert summary["confusion"][NEW] == [0, 0, 0, 3]
    assert summary["position_error_m"]["missed"] == 3
    assert summary["position_error_m"]["mean"] is None
    assert summary["position_error_m"]["nees"] is None


def test_signs_that_the_drive_does_not_mention_are_unclassified() -> None:
    silent = verdicts(known_id=np.zeros(0, np.int64), known_predicted=np.zeros(0, np.uint8))
    assert scored_drive(silent, TRUTH).confusion[:2].tolist() == [[0, 0, 0, 2], [0, 0, 0, 2]]


def test_signs_that_were_hidden_all_the_time_are_left_out_of_the_visible_ones_only() -> None:
    found = verdicts()
    summary = drive_summary(found, TRUTH)
    rest = TRUTH.take(found.visible > 0)
    assert len(rest.feature_id) == len(TRUTH.feature_id) - 2
    assert summary["accuracy_visible"] == accuracy_of(scored_drive(found, rest).confusion)
    assert summary["accuracy"] == accuracy_of(scored_drive(found, TRUTH).confusion)


def test_summary_of_a_drive_counts_looks_and_poses() -> None:
    summary = drive_summary(verdicts(), TRUTH)
    assert summary["looks"] == {
        "visible": 45, "occluded": 7, "signs_never_visible": 2, "new_signs_never_visible": 1,
    }  # fmt: skip
    assert summary["pose_rmse"] == pytest.approx(
        {"longitudinal_m": 1.0, "lateral_m": 0.5, "heading_deg": np.degrees(0.01)}
    )
    assert summary["step_ms_median"] == 2.0
    assert summary["position_error_m"]["false"] == 1


def test_the_papers_table_gives_the_papers_accuracies() -> None:
    found = accuracy_of(np.array(PAPER_CONFUSION))
    assert {name: round(value or 0.0, 0 if name != "overall" else 2) for name, value in found.items()} == PAPER_ACCURACY
    assert accuracy_of(np.zeros((3, 4)))["overall"] is None


def test_a_merged_layer_says_deleted_by_holding_a_sign_no_more() -> None:
    known = MeasuredSigns(np.array([1, 2, 4]), np.zeros((3, 2)), np.broadcast_to(np.eye(2), (3, 2, 2)))
    merged = MergedSigns(
        known.feature_id, np.array([[40.0, 0.0], [91.0, 0.0]]), np.broadcast_to(np.eye(2), (2, 2, 2)), known
    )
    scored = merged_score(merged, TRUTH)
    assert scored.confusion.tolist() == [[2, 0, 0, 0], [1, 1, 0, 0], [0, 0, 2, 1]]
    assert scored.distance_m == pytest.approx([0.0, 1.0])


def test_measured_signs_are_judged_where_they_stand_as_mapped() -> None:
    """The sign 3 is gone: where a drive has measured it says nothing. Claims that are too small show in the NEES."""
    places, cov = np.array([[0.0, 0.3], [10.4, 0.0], [20.0, 9.0]]), np.broadcast_to(0.01 * np.eye(2), (3, 2, 2))
    found = known_plain([MeasuredSigns(np.array([1, 2, 3]), places, cov)], TRUTH)
    assert found["found"] == 2
    assert found["mean"] == pytest.approx(0.35)
    assert found["nees"]["mean"] == pytest.approx((9.0 + 16.0) / 2)
    assert known_plain([], TRUTH)["nees"] is None


def test_a_wider_radius_finds_what_a_narrow_one_misses() -> None:
    new = (np.array([[93.0, 0.0]]), np.eye(2)[None])
    known = (np.zeros(0, np.int64), np.zeros(0, np.uint8))
    assert score(TRUTH, known, new, 2.0).missed == 3
    assert score(TRUTH, known, new, 4.0).missed == 2


def test_outliers_are_looks_that_spoke_for_the_wrong_state() -> None:
    found = verdicts()
    trace = found.trace_masses[found.trace_sign == 2]
    assert outliers(trace, EXIST).tolist() == [2]
    assert most_telling(found, TRUTH.of(DELETED), ABSENT) == 2
    assert most_telling(found, np.array([0, 1]), ABSENT) is None


def test_kept_verdicts_come_back_as_they_were(tmp_path: Path) -> None:
    kept, found = Kept(tmp_path, "drive", "ab12"), verdicts()
    kept.write((found, TRUTH))
    again, truth = kept.read(tuple[Verdicts, SignTruth])
    assert drive_summary(again, truth) == drive_summary(found, TRUTH)
    np.testing.assert_array_equal(again.trace_masses, found.trace_masses)
    kept.path.write_bytes(kept.path.read_bytes()[:200])
    with pytest.raises(FolderError, match="delete it and start again"):
        kept.read(tuple[Verdicts, SignTruth])


def off_by(metres: float, looks: int, chi2: float, **changes: object) -> Verdicts:
    """400 looks of which some, one after the other, are off along the road."""
    error = np.zeros((400, 3))
    error[50 : 50 + looks, 0] = metres
    squared = np.where(error[:, 0] > 0.0, chi2, 1.0)
    columns = {"pose_error": error, "pose_chi2": squared, "pose_given_up": np.zeros(400, np.bool_)}
    return verdicts(**{**columns, **changes})


def test_lost_without_knowing_is_far_off_for_long_and_beyond_what_is_claimed() -> None:
    assert lost_without_knowing(off_by(20.0, 75, 99.0)) == 1
    assert lost_without_knowing(off_by(20.0, 74, 99.0)) == 0
    assert lost_without_knowing(off_by(4.9, 200, 99.0)) == 0
    assert lost_without_knowing(off_by(20.0, 200, 9.0)) == 0  # it says that it does not know
    given_up = np.zeros(400, np.bool_)
    given_up[40:260] = True
    assert lost_without_knowing(off_by(20.0, 200, 99.0, pose_given_up=given_up)) == 0


def test_the_worst_drive_and_the_lost_ones_are_told() -> None:
    seeds = {
        "7": {"accuracy": {"overall": 99.0}, "lost": {"stretches": 0}, "lost_without_knowing": 0},
        "8": {"accuracy": {"overall": 60.0}, "lost": {"stretches": 2}, "lost_without_knowing": 1},
    }
    told = worst_of(seeds)
    assert told == {"worst": {"accuracy": 60.0, "seed": 8}, "lost": 1, "lost_without_knowing": 1, "drives": 2}


def test_the_distribution_is_that_of_the_first_drives() -> None:
    seeds = {
        str(n): {
            "accuracy": {"overall": 100.0 - n},
            "all_drives": {"position_error_m": {"false_a_drive": 0.5 * n}},
            "lost_without_knowing": int(n == 20) * 3,
        }
        for n in range(21)
    }
    found = distribution_of(seeds)
    assert found["distribution"] == {"mean": 90.0, "median": 90.0, "p5": 81.0, "worst": 80.0, "drives": 21}
    assert found["false_new_per_drive"] == 5.0
    assert found["lost_unnoticed"] == 1


def test_seeds_are_numbers_and_ranges() -> None:
    assert numbers("--seeds", "7,1000-1003") == (7, 1000, 1001, 1002, 1003)
    for text in ("5-3", "a-b", "1-", "-1-2"):
        with pytest.raises(click.BadParameter):
            numbers("--seeds", text)
