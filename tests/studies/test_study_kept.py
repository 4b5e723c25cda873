from pathlib import Path

import numpy as np
import pytest

from studies.localisation_study.kept import Kept, read_localised, read_trials, write_localised, write_trials
from studies.localisation_study.localising import Localised
from studies.localisation_study.series import PoseSeries
from studies.localisation_study.trials import Trial
from studies.simulation.errors import FolderError


def series(n: int) -> PoseSeries:
    rng = np.random.default_rng(n)
    return PoseSeries(np.arange(n, dtype=np.int64), rng.normal(size=(n, 3)), rng.integers(3, size=n).astype(np.uint8))


def test_a_run_comes_back_as_it_was(tmp_path: Path) -> None:
    kept = Kept(tmp_path / "runs", "vlp16-fresh", "abc")
    assert not kept.done
    write_localised(Localised(series(30), series(32), 33), 1.5, kept)
    assert kept.done
    found, cpu_s = read_localised(kept)
    assert (found.scans, cpu_s) == (33, 1.5)
    for one, other in ((found.final, series(30)), (found.online, series(32))):
        for column in ("t_ns", "error", "health"):
            assert np.array_equal(getattr(one, column), getattr(other, column))
    assert not Kept(kept.home, kept.name, "abd").done


def test_trials_come_back_as_they_were(tmp_path: Path) -> None:
    kept = Kept(tmp_path, "trials", "abc")
    trials = [Trial(1, 0.3, True, 0, 30), Trial(2, None, False, 2, 100)]
    write_trials(trials, 1.0, kept)
    assert read_trials(kept) == trials


def test_a_damaged_result_is_named(tmp_path: Path) -> None:
    kept = Kept(tmp_path, "vlp16-updated", "abc")
    write_localised(Localised(series(30), series(32), 33), 1.5, kept)
    kept.path.write_bytes(kept.path.read_bytes()[:100])
    with pytest.raises(FolderError, match=r"vlp16-updated-abc.npz.*delete it and start again"):
        read_localised(kept)


def test_a_result_of_another_kind_is_named(tmp_path: Path) -> None:
    kept = Kept(tmp_path, "vlp16-trials", "abc")
    write_trials([], 1.0, kept)
    with pytest.raises(FolderError, match="lacks"):
        read_localised(kept)
