from typing import Any

import pytest
from study_rows import no_pose, result, row, sensor

from studies.frame.averages import worst_of
from studies.frame.tables import markdown_of
from studies.localisation_study import series as reference
from studies.localisation_study.summary import ROWS, SMALLEST_IS_WORST, sheets_of, targets_of, within


def test_the_papers_numbers() -> None:
    assert not within(reference.PAPER["table2_without_submap"].plain(), reference.PAPER_LIMITS)
    assert within(reference.PAPER["table2_with_submap"].plain(), reference.PAPER_LIMITS)
    assert within(reference.PAPER["table2_with_submap"].plain(), reference.FORD_LOCAL)
    assert within(reference.PAPER["table6_after_update"].plain(), reference.PAPER_LIMITS)
    assert not within(reference.PAPER["table6_after_update"].plain(), reference.FORD_LOCAL, "p95")


@pytest.mark.parametrize(
    ("errors", "longest", "paper", "ford"),
    [
        ((0.10, 0.10, 0.17), 2.9, (True, True), (True, True)),
        ((0.101, 0.10, 0.17), 2.0, (True, True), (False, True)),
        ((0.10, 0.15, 0.17), 2.93, (True, True), (False, False)),
        ((0.10, 0.10, 0.171), 2.0, (False, True), (True, True)),
        ((0.01, 0.01, 0.10), 5.1, (True, False), (True, True)),
        ((0.10, 0.16, 0.01), 3.0, (False, False), (False, False)),
    ],
)
def test_limits(errors: Any, longest: float, paper: tuple[bool, bool], ford: tuple[bool, bool]) -> None:
    one = row(*errors, longest=longest)
    assert (within(one, reference.PAPER_LIMITS, "p95"), within(one, reference.PAPER_LIMITS, "max")) == paper
    assert (within(one, reference.FORD_LOCAL, "p95"), within(one, reference.FORD_LOCAL, "max")) == ford
    assert within(one, reference.PAPER_LIMITS) == all(paper)


def test_no_pose_passes_nothing() -> None:
    assert not within(no_pose(), reference.PAPER_LIMITS)
    targets = targets_of({"vlp16": sensor(with_submap=no_pose(), fresh=no_pose())})["vlp16"]
    assert not targets["with_submap"]["must"]
    assert not targets["after_update"]["must"]
    assert targets["after_update"]["ratio"] is None


def test_targets_differ_for_a_sensor_with_a_window() -> None:
    same = sensor(with_submap=row(0.04, 0.04, 0.09))
    found = targets_of({"vlp16": same, "scala": same})
    assert found["vlp16"]["with_submap"] == {"must": False, "aim": False}
    assert found["scala"]["with_submap"] == {"must": True, "aim": True}
    assert found["vlp16"]["reinitialisation"] == {"must": True, "aim": False}


def test_a_wrong_pose_called_good_fails_however_many_are_right() -> None:
    one = sensor()
    one["reinitialisation"] |= {"right": 40, "right_share": 1.0, "wrong_called_good": 1}
    assert targets_of({"vlp16": one})["vlp16"]["reinitialisation"] == {"must": False, "aim": False}


def test_the_updated_map_may_be_a_tenth_worse() -> None:
    met = targets_of({"vlp16": sensor(after_update=row(0.011, 0.01, 0.02))})["vlp16"]["after_update"]
    assert met == {"ratio": {"longitudinal_m": 1.1, "lateral_m": 1.0, "heading_deg": 1.0}, "must": True}
    assert not targets_of({"vlp16": sensor(after_update=row(0.01, 0.01, 0.0221))})["vlp16"]["after_update"]["must"]


def test_of_several_seeds_the_worst_counts() -> None:
    a, b = sensor(), sensor(with_submap=row(0.02, 0.005, 0.05), online=no_pose())
    a["with_submap"]["coverage"], b["reinitialisation"]["right_share"] = 0.5, 0.6
    b["reinitialisation"]["wrong_called_good"] = 2
    found = worst_of([a, b], SMALLEST_IS_WORST)
    assert found["with_submap"]["longitudinal_m"] == {"p95": 0.02, "max": 0.04}
    assert found["with_submap"]["lateral_m"] == {"p95": 0.01, "max": 0.02}
    assert found["with_submap"]["coverage"] == 0.5
    assert found["online"]["longitudinal_m"] is None
    assert (found["reinitialisation"]["right_share"], found["reinitialisation"]["wrong_called_good"]) == (0.6, 2)


def test_tables_show_every_row_and_the_papers() -> None:
    rows = sheets_of(result(vlp16=sensor()))[1].rows
    assert len([cells for cells, style in rows if not style]) == len(ROWS)
    assert len([cells for cells, style in rows if style == "dim"]) == len(reference.PAPER)
    without = rows[1][0]
    assert without[:4] == (
        "paper, Table 2, without submap", "0.0841 / 0.2002", "0.3012 / 1.4518", "1.1388 / 6.2191",
    )  # fmt: skip
    assert without[5] == "FAIL / FAIL"
    assert rows[0][0][4:7] == ("97.1 %", "pass / pass", "pass / pass")


def test_markdown_is_one_table_a_sensor_with_equal_columns() -> None:
    sheets = sheets_of(result(vlp16=sensor(), scala=sensor(with_submap=no_pose())))
    text = markdown_of(sheets, "gnd reproduce localisation")
    tables = [line for line in text.splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in tables}) == 1
    assert text.count("no pose") == 3
    assert "Of every number the worst of the worlds" in text
    assert "world 2: 300 m, 30 edits, 21.0 % of the Gaussians changed" in text
    assert "40 starts 2.5 m off, any heading: 39 right within 15 s (97.5 %)" in text
