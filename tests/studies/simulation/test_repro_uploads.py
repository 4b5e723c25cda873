"""Reports in short against whole ones: the same drives, the same map but for a hair, a fraction of the bytes."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from repro_world import reproduce, result_of

from gnd.cloud_merger.merge import MergeParameters
from gnd.schemas.changes import ChangeReport
from studies.simulation.base_map import read_base
from studies.simulation.cloud import arrived
from studies.simulation.losses import analyse
from studies.simulation.result import VehicleResult, read_result

Finished = tuple[Path, dict[str, Any]]


def results_in(out: Path) -> list[VehicleResult]:
    """The vehicles of a finished run, in the order of their names."""
    paths = sorted(path for path in out.glob("seed-*/vehicles/*.npz"))
    keys = [json.loads(str(np.load(path, allow_pickle=False)["head"]))["key"] for path in paths]
    return [read_result(path, key) for path, key in zip(paths, keys, strict=True)]


@pytest.mark.slow
def test_in_short_the_map_is_as_good_and_the_upload_a_fraction(finished: Finished, tmp_path: Path) -> None:
    out, whole = finished
    other = Path(shutil.copytree(out, tmp_path / "packed"))
    before = {path.name for path in other.glob("seed-*/vehicles/*.npz")}
    short = result_of(other, "--upload", "packed")
    assert {path.name for path in other.glob("seed-*/vehicles/*.npz")} == before, "no vehicle drove again"
    assert short["fleet"]["1"] == whole["fleet"]["1"], "the first vehicle is asked for everything"
    assert short["fleet"]["2"]["f1"]["scored"] > whole["fleet"]["2"]["f1"]["scored"] - 1.0
    for n in ("1", "2"):
        assert 15 * short["upload_bytes"]["fleet"][n] < whole["upload_bytes"]["fleet"][n]
    assert short["parameters"]["upload"] == "packed"
    confusion = np.array(short["confusion"]["fleet"]["2"]["all"])
    assert confusion.tolist() != whole["confusion"]["fleet"]["2"]["all"], "else the next line shows nothing"
    losses = analyse(other, ["2"], ["all"])["2"]["all"]
    assert sum(loss["voxels"] for loss in losses) == confusion.sum() - np.trace(confusion)


def test_the_cloud_holds_what_was_flagged_and_the_gaussians_that_it_asked_for(finished: Finished) -> None:
    out, _ = finished
    results = results_in(out)
    base = read_base(next(out.glob("seed-*/base-surveyed.npz")))
    held = arrived(base, results, MergeParameters(), "packed")
    assert [one.bodies for one in arrived(base, results, MergeParameters(), "full")] == [r.reports for r in results]
    for result, one in zip(results, held, strict=True):
        for body, kept in zip(result.reports, one.bodies, strict=True):
            said, here = ChangeReport.decode(body), ChangeReport.decode(kept)
            assert (here.report_id, here.vehicle) == (said.report_id, said.vehicle)
            for a, b in zip(said.tiles, here.tiles, strict=True):
                assert a.changed.voxel_id.tolist() == b.changed.voxel_id.tolist()
                assert a.change_class.tolist() == b.change_class.tolist()
                there = b.changed.exists
                assert a.changed.take(there) == b.changed.take(there)
    first = ChangeReport.decode(held[0].bodies[0])
    assert all(change.changed.exists.any() for change in first.tiles if (change.change_class < 3).any())


def test_an_upload_of_another_kind_is_refused(tmp_path: Path) -> None:
    ran = reproduce(tmp_path / "out", "--upload", "zip")
    assert ran.exit_code == 2
    assert "zip" in ran.output
