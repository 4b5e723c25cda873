import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from study_world import json_of, run_study

from gnd.deploy.cli import gnd
from gnd.gnd_map.errors import GndError
from studies.localisation_study.series import QUANTITIES, STATISTICS
from studies.localisation_study.summary import ROWS

Studied = tuple[Path, dict[str, Any]]
ROW_KEYS = {*QUANTITIES, "poses", "scans", "coverage", "good_share", "wrong_called_good"}


@pytest.fixture(scope="module")
def studied(tmp_path_factory: pytest.TempPathFactory) -> Studied:
    """Folder and JSON of a finished study."""
    out = tmp_path_factory.mktemp("study") / "run"
    return out, json_of(out)


def without_times(found: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in found.items() if key != "runtime_s"}


def runs_of(out: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in out.glob("seed-*/runs/*.npz")}


@pytest.mark.slow
def test_json_has_the_keys_of_the_issue(studied: Studied) -> None:
    _, found = studied
    for row in ("without_submap", "with_submap", "after_update"):
        for quantity in QUANTITIES:
            for statistic in STATISTICS:
                assert 0.0 <= found["vlp16"][row][quantity][statistic] < 0.5
    assert set(found["vlp16"]) == {*ROWS, "reinitialisation", "update_ratio", "cpu_s"}
    assert all(set(found["vlp16"][row]) == ROW_KEYS for row in ROWS)
    assert found["vlp16"]["reinitialisation"]["trials"] == 2
    assert {"targets", "paper", "limits", "world", "seeds", "parameters", "runtime_s"} <= set(found)
    assert found["seeds"]["5"]["vlp16"] == found["vlp16"]
    assert found["paper"]["table2_with_submap"]["lateral_m"] == {"p95": 0.012499, "max": 0.030573}
    assert set(found["limits"]["ford_local"]) == {"longitudinal_m", "lateral_m"}


@pytest.mark.slow
def test_most_scans_have_a_pose_and_the_world_has_changed(studied: Studied) -> None:
    _, found = studied
    assert found["vlp16"]["with_submap"]["scans"] == 45
    assert all(found["vlp16"][row]["coverage"] > 0.8 for row in ROWS)
    assert 0.1 < found["world"]["changed_share"] < 0.5
    assert sum(found["world"]["edits"].values()) > found["world"]["edits"]["kept"] > 0
    gaussians = found["world"]["gaussians"]
    assert len(set(gaussians.values())) == 3


@pytest.mark.slow
def test_a_second_start_uses_what_is_there_and_makes_what_is_missing(studied: Studied, tmp_path: Path) -> None:
    out, found = studied
    other = tmp_path / "again"
    shutil.copytree(out, other)
    before = runs_of(other)
    gone = next(path for path in before if "vlp16-fresh" in path.name)
    gone.unlink()
    assert without_times(rounded_times(json_of(other))) == without_times(rounded_times(found))
    after = runs_of(other)
    assert set(after) == set(before)
    assert [path for path in after if after[path] != before[path]] == [gone]
    assert not list(other.glob("seed-*/drives/*"))


def rounded_times(found: dict[str, Any]) -> dict[str, Any]:
    """The result without what the clock decides."""
    plain = json.loads(json.dumps(found))
    for rows in (plain["vlp16"], plain["seeds"]["5"]["vlp16"]):
        del rows["cpu_s"]
    return dict(plain)


@pytest.mark.slow
def test_pictures_and_markdown(studied: Studied, tmp_path: Path) -> None:
    out, _ = studied
    ran = run_study(out, "--markdown", str(tmp_path / "tables.md"))
    assert ran.exit_code == 0, ran.output
    assert "with submap" in ran.stdout
    for name in ("vlp16_submaps", "vlp16_update"):
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    text = (tmp_path / "tables.md").read_text()
    assert text.startswith("`gnd reproduce localisation --seeds 5 ")
    assert "**vlp16: 95 % / maximum**" in text


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--sensors", "vlp17"), "--sensors: there is no vlp17"),
        (("--sensors", ""), "--sensors: each once, got none"),
        (("--sensors", "vlp16,vlp16"), "each once, got vlp16, vlp16"),
        (("--world-seed", "-3"), "must be different integers >= 0"),
        (("--world-seed", "7,7"), "different"),
        (("--world-seed", "seven"), "expected numbers"),
        (("--fleet", "0"), "--fleet must be at least 1, got 0"),
        (("--trials", "-1"), "--trials must be at least 0, got -1"),
        (("--poses", "guessed"), "noisy:4cm:0.08deg"),
        (("--set", "localise.graph.lag=2"), "localise.graph.lag"),
        (("--length", "7"), "100"),
        (("--jobs", "0"), "at least one process"),
        (("--json", "-", "--markdown", "-"), "only one"),
    ],
)
def test_bad_options_are_refused(tmp_path: Path, options: tuple[str, ...], says: str) -> None:
    given = ("--sensors", "vlp16", *options, "--out", str(tmp_path / "out"))
    ran = CliRunner().invoke(gnd, ["reproduce", "localisation", *given])
    assert ran.exit_code != 0
    assert says in ran.output + str(ran.exception)
    assert isinstance(ran.exception, (GndError, SystemExit))
    assert not (tmp_path / "out").exists()


def test_a_folder_of_another_command_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text(json.dumps({"format": "gnd.reproduce.simulation"}))
    ran = run_study(tmp_path)
    assert "holds no run of `gnd reproduce localisation`" in str(ran.exception)
