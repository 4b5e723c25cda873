"""What the studies run on, made once: a finished run, and the truth of each street."""

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from prepared import Prepared
from repro_world import result_of

from gnd.fleet_sim import truth as truths
from gnd.fleet_sim.truth import ScanPlan, Truth, TruthRules, make_truth, read_truth, world_sha, write_truth
from gnd.fleet_sim.world import World
from studies.benchmark import export


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Folder and JSON of a finished run."""
    out = tmp_path_factory.mktemp("reproduce") / "run"
    return out, result_of(out)


@pytest.fixture(scope="session", autouse=True)
def truth_once(prepared: Prepared) -> Iterator[None]:
    """The truth of a street is scanned once for all commands that run on it in these processes: six seconds each."""

    def truth_of(world: World, rules: TruthRules | None = None, plan: ScanPlan | None = None) -> Truth:
        what = repr((world_sha(world), rules, plan or ScanPlan()))

        def make(folder: Path) -> None:
            write_truth(make_truth(world, rules, plan), folder / "truth.npz")

        return read_truth(prepared(f"truth-{hashlib.sha256(what.encode()).hexdigest()}", make) / "truth.npz")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(truths, "make_truth", truth_of)
        patch.setattr(export, "make_truth", truth_of)
        yield
