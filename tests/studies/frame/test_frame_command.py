"""A study of a few lines on the frame: JSON, Markdown, tables, resume, refusals."""

import json
import math
from dataclasses import dataclass
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from studies.frame.averages import worst_of
from studies.frame.command import Bench, StudyReport, study
from studies.frame.kept import Kept
from studies.frame.options import check, option, seeds
from studies.frame.pool import Job
from studies.frame.tables import Sheet, sheet_of
from studies.frame.targets import Target, judged, targets_sheet


@dataclass(frozen=True, slots=True)
class Options:
    """Of factorials."""

    seeds: tuple[int, ...] = seeds(5)
    most: int = option(20, "The largest.", span=(1, 30))

    def __post_init__(self) -> None:
        check(self)


@study(Options, out="runs/factorials", jobs=1)
def factorials(options: Options, bench: Bench) -> StudyReport:
    """Factorials of the seeds."""
    kept = {seed: Kept(bench.folder.root / "runs", f"factorial-{seed}", "k") for seed in options.seeds}
    missing = [seed for seed in options.seeds if not kept[seed].done]
    for seed, value in zip(missing, bench.run("work", [_job(seed) for seed in missing]), strict=True):
        kept[seed].write({"value": value})
    rows = {str(seed): one.read(dict[str, int]) for seed, one in kept.items()}
    targets = judged({"last": rows[max(rows)]}, (Target("last", "last.value", "", "24", 100, 200, larger=True),))
    sheets = [sheet_of("factorials", {"n!": "{value:,}"}, rows, "n"), targets_sheet(targets, "targets")]
    return StudyReport(
        {"rows": rows, "targets": targets}, sheets, lambda folder: (folder / "drawn.png").write_bytes(b"-")
    )


def _job(seed: int) -> Job:
    return Job(f"factorial {seed}", math.factorial, (seed,))


def run(out: Path, *words: str) -> Result:
    return CliRunner().invoke(factorials, [*words, "--out", str(out)])


def test_json_markdown_and_pictures(tmp_path: Path) -> None:
    ran = run(tmp_path / "a", "--seeds", "3-5", "--json", "-", "--markdown", str(tmp_path / "t.md"))
    assert ran.exit_code == 0, ran.output
    found = json.loads(ran.stdout)
    assert found["rows"] == {"3": {"value": 6}, "4": {"value": 24}, "5": {"value": 120}}
    assert found["targets"]["last"]["met"]
    assert not found["targets"]["last"]["aim_met"]
    assert json.loads((tmp_path / "a" / "result.json").read_text()) == found
    assert json.loads((tmp_path / "a" / "run.json").read_text())["options"] == {"seeds": [3, 4, 5], "most": 20}
    assert (tmp_path / "a" / "drawn.png").is_file()
    text = (tmp_path / "t.md").read_text()
    assert text.startswith("`gnd reproduce factorials --seeds 3-5`")
    assert "| 5 | 120 |" in text


def test_a_second_start_takes_what_is_kept(tmp_path: Path) -> None:
    run(tmp_path, "--seeds", "4", "--no-pictures")
    assert not (tmp_path / "drawn.png").exists()
    kept = Kept(tmp_path / "runs", "factorial-4", "k")
    kept.write({"value": 7})
    assert "7" in run(tmp_path, "--seeds", "4,3").stdout


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--most", "31"), "--most must be 1 … 30, got 31"),
        (("--jobs", "0"), "at least one process"),
        (("--json", "-", "--markdown", "-"), "only one"),
    ],
)
def test_refusals_leave_nothing_behind(tmp_path: Path, words: tuple[str, ...], says: str) -> None:
    ran = run(tmp_path / "out", *words)
    assert ran.exit_code != 0
    assert says in ran.output + str(ran.exception)
    assert not (tmp_path / "out").exists()


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("precious")
    assert "holds no run of this command" in str(run(tmp_path).exception)


def test_cells_show_nested_values_and_dashes() -> None:
    rows = {"a": {"error": {"p95": 1.234}, "n": 2}, "b": {"error": None, "n": 0}}
    table = sheet_of("t", {"p95": "{error.p95:.2f} m", "n": "{n}"}, rows)
    assert [cells for cells, _ in table.rows] == [("a", "1.23 m", "2"), ("b", "– m", "0")]
    marked = Sheet("t", ("a",))
    marked.add("x", style="dim")
    assert "| *x* |" in marked.markdown()


def test_the_worst_is_the_largest_but_for_what_is_named() -> None:
    many = [
        {"error": 1.0, "share": {"good": 0.9}},
        {"error": 2.0, "share": {"good": 0.5}},
        {"error": 0.0, "share": None},
    ]
    assert worst_of(many[:2], ("good",)) == {"error": 2.0, "share": {"good": 0.5}}
    assert worst_of(many, ("good",))["share"] is None
