"""`make bench`: the walk in C counts the same to the bit, every entrant runs, and the page says what was measured."""

import re
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from gnd.vehicle_agent.detect.kernel import cast_rays
from studies.frame.tables import Sheet
from studies.speed import yardstick
from studies.speed.__main__ import SPARSE, contests, page
from studies.speed.contest import Absent, Contest, Entrant, raced
from studies.speed.rays import Walk, placed
from studies.speed.scene import SpeedOptions, SpeedScene, scene_of

pytestmark = pytest.mark.slow
SMALL = SpeedOptions(rounds=1, scans=3, length_m=100.0)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SpeedScene:
    """A short street; of its drive, and of the points on which others match, only a part."""
    whole = scene_of(SMALL, SPARSE, tmp_path_factory.mktemp("speed"))
    return replace(whole, drive=whole.drive[: len(whole.drive) // 3], cloud=whole.cloud[::6])


@pytest.mark.skipif(yardstick.compiler() is None, reason="needs gcc")
def test_the_same_walk_in_c_counts_the_same_to_the_bit(scene: SpeedScene, tmp_path: Path) -> None:
    walk = Walk(scene, placed(scene))
    ours, in_c = walk.counts(cast_rays), walk.counts(yardstick.compiled(tmp_path))
    for a, b in zip(ours, in_c, strict=True):
        np.testing.assert_array_equal(a, b)
    assert (ours.words[:, 12:].sum(axis=0) > 100).all(), "all four cases were counted"


def test_the_result_of_who_walks_wrongly_says_so(
    scene: SpeedScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "wrong.c"
    source.write_text(yardstick.SOURCE.read_text().replace("state[at] = (int32_t)(row - 1)", "state[at] = row"))
    monkeypatch.setattr(yardstick, "SOURCE", source)
    walk = Walk(scene, placed(scene))
    ours, wrong = walk.counts(cast_rays), walk.counts(yardstick.compiled(tmp_path))
    assert not np.array_equal(ours.state, wrong.state)


def test_every_contest_runs_and_its_page_has_a_row_for_everybody(
    scene: SpeedScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("studies.speed.__main__.scene_of", lambda *_: scene)
    sheets = [raced(contest, 1) for contest in contests(SMALL, tmp_path)]
    assert [len(sheet.rows) for sheet in sheets] == [2, 3, 3, 2, 3, 3, 5, 5]
    for sheet in sheets:
        for cells, _ in sheet.rows:
            assert "not installed" in cells[4] or float(cells[1]) > 0
    text = page("the command", sheets, datetime(2026, 1, 2, tzinfo=UTC))
    assert all(part in text for part in ("    the command", "2026-01-02", " cores, ", "numba 0.", "## Odometry"))
    assert "counts equal to the bit: True" in text or yardstick.compiler() is None
    assert re.search(r"100% converged, of these median 0\.\d\d cm", text)


def test_ratios_are_taken_within_a_round_and_who_is_missing_is_named() -> None:
    def spin(times: int) -> int:
        return sum(range(times))

    ours = Entrant("ours", lambda: spin(200_000), str)
    sheet: Sheet = raced(
        Contest("spinning", "ms", 1.0, ours, [Entrant("thrice", lambda: spin(600_000), str), Absent("none", "away")]), 9
    )
    (own, thrice, absent) = [cells for cells, _ in sheet.rows]
    assert own[3] == "1"
    assert 2.0 < float(thrice[3].split()[0]) < 4.5
    assert (absent[1], absent[4]) == ("not run", "away")
