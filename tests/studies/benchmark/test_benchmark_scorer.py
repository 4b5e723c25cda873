"""The scorer that strangers get: it agrees with our own to the bit, and refuses what cannot be meant."""

import ast
import csv
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from made_truth import FRAME, VEHICLES, changed_map, made_truth, write_export

from gnd.deploy.cli import gnd
from gnd.fleet_sim.evaluate import evaluate_maps
from gnd.fleet_sim.truth import LEVELS, Truth
from studies.benchmark.frames import IndexFrame
from studies.benchmark.kit import score as kit
from studies.benchmark.run import changes_between, write_submission

Made = tuple[Path, dict[str, Truth]]
CHANGES = ("new", "modified", "deleted")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    truths = {"street-1": made_truth(1), "suburb-2": made_truth(2)}
    return write_export(tmp_path_factory.mktemp("made"), truths), truths


def submitted(made: Made, path: Path, *whos: str) -> Path:
    found: dict[str, Any] = {}
    for at, (name, truth) in enumerate(made[1].items()):
        frame = IndexFrame.around(truth)
        found[name] = {who: changes_between(frame, truth.before, truth.before, changed_map(truth, 10 * at + number))
                       for number, who in enumerate(whos)}  # fmt: skip
    write_submission(path, found)
    return path


def scores_of(folder: Path, submission: Path) -> dict[str, Any]:
    worlds = kit.read_worlds(folder)
    return kit.score(worlds, kit.read_submission(submission, worlds))


def test_it_agrees_with_the_scores_of_the_project_to_the_bit(made: Made, tmp_path: Path) -> None:
    found = scores_of(made[0], submitted(made, tmp_path / "s.csv", "merged", *VEHICLES))
    assert found["missing"] == []
    for at, (name, truth) in enumerate(made[1].items()):
        for number, who in enumerate(("merged", *VEHICLES)):
            ours = evaluate_maps(truth, truth.before, changed_map(truth, 10 * at + number))
            theirs = found["merged" if who == "merged" else "single"]["maps"][f"{name}/{who}"]
            for level in LEVELS:
                score = ours.scores[level]
                assert theirs[level]["confusion"] == score.confusion.tolist()
                assert (theirs[level]["f1"], theirs[level]["changes_f1"]) == (score.macro_f1, score.changes_f1)
                assert theirs[level]["false_per_1000"] == score.false_per_1000
                assert {n: (c["precision"], c["recall"], c["f1"]) for n, c in theirs[level]["classes"].items()} == {
                    n: (c.precision, c.recall, c.f1) for n, c in score.classes.items()
                }
            assert theirs["unknown_voxels"] > 0
        stale = evaluate_maps(truth, truth.before, truth.before)
        assert found["stale"]["maps"][name]["observable"]["f1"] == stale.f1("observable")


def test_the_mean_and_the_worst_are_those_of_the_maps(made: Made, tmp_path: Path) -> None:
    single = scores_of(made[0], submitted(made, tmp_path / "s.csv", *VEHICLES))["single"]
    parts = [one["observable"] for one in single["maps"].values()]
    assert len(parts) == 4
    assert single["mean"]["observable"]["f1"] == np.mean([one["f1"] for one in parts])
    assert single["worst"]["observable"]["f1"] == min(one["f1"] for one in parts)
    false = [sum(one["false_per_1000"].values()) for one in parts]
    assert (
        single["worst"]["observable"]["false_per_1000"] == max(false) > single["mean"]["observable"]["false_per_1000"]
    )


def test_the_truth_itself_scores_everything(made: Made, tmp_path: Path) -> None:
    rows = ["world,i,j,k,class"]
    for name, truth in made[1].items():
        ijk = IndexFrame.around(truth).ijk(truth.morton, truth.voxel_id)
        classes = [kit.CLASSES[c] for c in truth.change_class]
        rows += [f"{name},{i},{j},{k},{c}" for (i, j, k), c in zip(ijk.tolist(), classes, strict=True) if c in CHANGES]
    (tmp_path / "truth.csv").write_text("\n".join(rows))
    found = scores_of(made[0], tmp_path / "truth.csv")
    assert found["merged"]["worst"]["all"] == {
        "f1": 100.0, "changes_f1": 100.0, "new": 100.0, "modified": 100.0, "deleted": 100.0, "false_per_1000": 0.0,
    }  # fmt: skip
    assert found["stale"]["mean"]["all"]["changes_f1"] == 0.0
    assert "single" not in found


def test_points_and_json_lines_score_as_voxels_do(made: Made, tmp_path: Path) -> None:
    as_csv = submitted(made, tmp_path / "s.csv", "merged")
    lines = []
    for row in csv.DictReader(as_csv.read_text().splitlines()):
        frame = IndexFrame.around(made[1][row["world"]])
        g = np.array([[int(row[name]) for name in "ijk"]]) + frame.first
        for inside in (0.01, 0.99):  # two points of one voxel
            x, y, z = frame.grid.map_of_grid(g + inside)[0].tolist()
            lines.append(json.dumps({"world": row["world"], "x": x, "y": y, "z": z, "class": row["class"]}))
    (tmp_path / "s.jsonl").write_text("\n".join(lines))
    assert scores_of(made[0], tmp_path / "s.jsonl") == scores_of(made[0], as_csv)


def test_what_is_left_out_counts_as_no_change_and_is_named(made: Made, tmp_path: Path) -> None:
    whole = submitted(made, tmp_path / "s.csv", "vehicle-00")
    kept = [line for line in whole.read_text().splitlines() if not line.startswith("suburb-2")]
    (tmp_path / "part.csv").write_text("\n".join(kept))
    found = scores_of(made[0], tmp_path / "part.csv")
    assert found["missing"] == ["street-1/vehicle-01", "suburb-2/vehicle-00", "suburb-2/vehicle-01"]
    assert found["single"]["worst"]["all"]["changes_f1"] == 0.0
    assert "suburb-2/vehicle-01" in kit.table_of(found)


@pytest.mark.parametrize(
    ("row", "what"),
    [
        ("street-9,merged,1,1,1,new", "unknown world 'street-9'"),
        ("street-1,vehicle-07,1,1,1,new", "unknown vehicle 'vehicle-07'"),
        ("street-1,merged,1,1,1,normal", "class 'normal'"),
        ("street-1,merged,1,nan,1,new", "finite numbers are needed"),
        ("street-1,merged,1,1.5,1,new", "integers are needed"),
        ("street-1,merged,1,one,1,new", "could not convert string to float: 'one'"),
        ("street-1,merged,1,,1,new", "no j; world, class"),
        ("street-1,merged,-1,0,0,new", "outside of the world street-1"),
        ("street-1,merged,0,0,100000,new", "outside of the world street-1"),
        ("street-1,merged,0,0,0,deleted", "holds no Gaussian there"),
        ("HELD,new", "holds a Gaussian there"),
        ("street-1,merged,0,0,0,new\nstreet-1,merged,0,0,0,new", "was reported on line 2 already"),
    ],
)
def test_it_refuses_with_the_line(made: Made, tmp_path: Path, row: str, what: str) -> None:
    folder, truths = made
    truth = truths["street-1"]
    tile, held = next((t, g) for t, g in truth.before.items() if len(g))
    i, j, k = IndexFrame.around(truth).ijk(np.array([tile.morton]), held.voxel_id[:1])[0]
    path = tmp_path / "bad.csv"
    path.write_text("world,vehicle,i,j,k,class\n" + row.replace("HELD", f"street-1,merged,{i},{j},{k}"))
    with pytest.raises(kit.SubmissionError, match=r"bad\.csv:[23]: ") as caught:
        scores_of(folder, path)
    assert what in str(caught.value)


@pytest.mark.parametrize(
    "line",
    [
        '{"world": "street-1", "class": "new", "i": 1' + 400 * "0" + ', "j": 1, "k": 1}',
        '{"world": "street-1", "class": "new", "i": ' + 5000 * "1" + ', "j": 1, "k": 1}',
        '{"world": "street-1", "class": "new", "x": 1e300, "y": 1, "z": 1}',
        '{"world": "street-1", "class": "new", "x": [1], "y": 1, "z": 1}',
        '{"world": ["street-1"], "class": ["new"], "x": 1, "y": 1, "z": 1}',
        '{"world": "street-1", "class": "new", "i": 1e18, "j": 1, "k": 1}',
        100_000 * "[",
        '["street-1", "merged"]',
        "null",
        "{",
        "\x00",
        "\ud800",
    ],
)
def test_hostile_lines_are_refused(made: Made, tmp_path: Path, line: str) -> None:
    path = tmp_path / "bad.jsonl"
    path.write_bytes(line.encode("utf-8", "surrogatepass") + b"\n")
    with pytest.raises(kit.SubmissionError, match=r"bad\.jsonl"):
        scores_of(made[0], path)


def test_a_mark_of_utf_8_before_the_head_is_no_column(made: Made, tmp_path: Path) -> None:
    """Spreadsheets write one."""
    (tmp_path / "marked.csv").write_text("\ufeffworld,vehicle,i,j,k,class\n", encoding="utf-8")
    assert kit.read_submission(tmp_path / "marked.csv", kit.read_worlds(made[0])) == {}


def test_points_of_one_voxel_may_not_contradict_each_other(made: Made, tmp_path: Path) -> None:
    frame = IndexFrame.around(made[1]["street-1"])
    x, y, z = frame.grid.map_of_grid(frame.first[None] + 0.5)[0]
    (tmp_path / "bad.csv").write_text(f"world,x,y,z,class\nstreet-1,{x},{y},{z},new\nstreet-1,{x},{y},{z},deleted\n")
    with pytest.raises(kit.SubmissionError, match=r"bad\.csv:3: .* line 2 already"):
        scores_of(made[0], tmp_path / "bad.csv")


@pytest.mark.parametrize("damage", ["benchmark.json", "worlds/street-1/frame.json", "truth/suburb-2/voxels.npz"])
def test_a_damaged_folder_is_named(made: Made, tmp_path: Path, damage: str) -> None:
    folder = write_export(tmp_path / "own", made[1])
    whole = (folder / damage).read_bytes()
    for torn in (b"{", b"[]", whole[: len(whole) // 2]):
        (folder / damage).write_bytes(torn)
        with pytest.raises(kit.SubmissionError, match=r"own"):
            kit.read_worlds(folder)


def test_its_voxels_are_those_of_the_map() -> None:
    truth = made_truth(3)
    frame = IndexFrame.around(truth)
    points = np.random.default_rng(5).uniform(-400.0, 400.0, (20_000, 3))
    theirs = kit.VoxelFrame(FRAME.lat_rad, FRAME.lon_rad, FRAME.height_m, frame.grid.nx, frame.grid.ny,
                            tuple(frame.first.tolist()), tuple(frame.size.tolist()))  # fmt: skip
    ours = frame.grid.grid_of(points) - frame.first
    assert np.abs(theirs.coordinates_of(points) - ours).max() < 1e-7
    assert (theirs.voxels_of(points) == np.floor(ours)).all()


@pytest.mark.parametrize("name", ["score.py", "example.py"])
def test_what_travels_needs_numpy_alone(name: str) -> None:
    tree = ast.parse((Path(kit.__file__).parent / name).read_text())
    used = {alias.name.split(".")[0] for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    used |= {str(node.module).split(".")[0] for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert used - set(sys.stdlib_module_names) <= {"numpy", "score"}


def test_the_command_is_the_script(made: Made, tmp_path: Path) -> None:
    submission = submitted(made, tmp_path / "s.csv", "merged")
    script = [sys.executable, "-I", str(Path(kit.__file__)), str(made[0]), str(submission)]
    alone = subprocess.run([*script, "--json"], capture_output=True, text=True, check=True).stdout
    ran = CliRunner().invoke(gnd, ["benchmark", "score", str(made[0]), str(submission), "--json"])
    assert ran.exit_code == 0
    assert json.loads(alone) == json.loads(ran.stdout) == scores_of(made[0], submission)
    table = CliRunner().invoke(gnd, ["benchmark", "score", str(made[0]), str(submission)]).stdout
    assert f"{scores_of(made[0], submission)['merged']['mean']['observable']['f1']:.2f}" in table
    wrong = subprocess.run([*script[:-1], str(tmp_path / "none.csv")], capture_output=True, text=True, check=False)
    assert (wrong.returncode, wrong.stdout) == (2, "")
    assert "none.csv cannot be read" in wrong.stderr
