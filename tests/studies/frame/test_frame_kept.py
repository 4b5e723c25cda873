from pathlib import Path

import numpy as np
import pytest

from studies.frame.errors import FolderError
from studies.frame.kept import Kept, _files, sources_sha
from studies.hard_cases import study as hard_cases
from studies.localisation_study import study as localisation
from studies.localisation_study.localising import LocalisedVariant
from studies.localisation_study.series import PoseSeries
from studies.localisation_study.study import RunResult
from studies.localisation_study.trials import StartTrial
from studies.modified_study import study as modified
from studies.new_layer_study import study as new_layer
from studies.new_road import study as new_road
from studies.simulation import worlds
from studies.slamcu_study import study as slamcu


def series(n: int) -> PoseSeries:
    rng = np.random.default_rng(n)
    return PoseSeries(np.arange(n, dtype=np.int64), rng.normal(size=(n, 3)), rng.integers(3, size=n).astype(np.uint8))


def test_a_run_comes_back_as_it_was(tmp_path: Path) -> None:
    kept = Kept(tmp_path / "runs", "vlp16-fresh", "abc")
    assert not kept.done
    kept.write(RunResult(LocalisedVariant(series(30), series(32), 33), 1.5))
    assert kept.done
    again = kept.read(RunResult)
    assert (again.found.scans, again.cpu_s) == (33, 1.5)
    for one, other in ((again.found.final, series(30)), (again.found.online, series(32))):
        for column in ("t_ns", "error", "health"):
            assert np.array_equal(getattr(one, column), getattr(other, column))
    assert not Kept(kept.home, kept.name, "abd").done


def test_plain_values_bytes_and_tables_come_back_as_they_were(tmp_path: Path) -> None:
    kept = Kept(tmp_path, "trials", "abc")
    trials = [StartTrial(1, 0.3, True, 0, 30), StartTrial(2, None, False, 2, 100)]
    kept.write(trials)
    assert kept.read(list[StartTrial]) == trials
    kept.write({"a": (b"", b"xyz"), "b": ()})
    assert kept.read(dict[str, tuple[bytes, ...]]) == {"a": (b"", b"xyz"), "b": ()}


def test_a_damaged_result_is_named(tmp_path: Path) -> None:
    kept = Kept(tmp_path, "vlp16-updated", "abc")
    kept.write(RunResult(LocalisedVariant(series(30), series(32), 33), 1.5))
    kept.path.write_bytes(kept.path.read_bytes()[:100])
    with pytest.raises(FolderError, match=r"vlp16-updated-abc.npz.*delete it and start again"):
        kept.read(RunResult)


def test_a_result_of_another_kind_is_named(tmp_path: Path) -> None:
    kept = Kept(tmp_path, "vlp16-trials", "abc")
    kept.write(StartTrial(1, 0.3, True, 0, 30))
    with pytest.raises(FolderError, match="lacks"):
        kept.read(RunResult)


def test_a_source_that_is_not_there_is_named() -> None:
    with pytest.raises(FileNotFoundError, match="nowhere"):
        sources_sha(("vehicle_agent/tracks.py", "vehicle_agent/nowhere.py"))


@pytest.mark.parametrize(
    "sources",
    [
        *(worlds.VEHICLE, worlds.PCD, slamcu.SOURCES, new_layer.MERGE_SOURCES, localisation._RUNS, localisation._CLOUD),
        *(hard_cases._VEHICLE, hard_cases._MAPS, modified._SIMULATED, modified._RECORDED),
        *(new_road._BASE, new_road._DRIVE),
    ],
)
def test_whatever_a_result_depends_on_is_there(sources: tuple[str, ...]) -> None:
    assert len(sources_sha(sources)) == 64


def test_a_simulated_vehicle_depends_on_what_it_sends() -> None:
    names = {path.name for part in worlds.VEHICLE for path in _files(part)}
    assert {"reporter.py", "packing.py", "classify.py", "drives.py"} <= names
