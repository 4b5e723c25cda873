import math
import os
from pathlib import Path

import pytest
from rich.progress import Progress

from gnd.gnd_map.tile_id import TileId
from studies.frame.errors import FolderError, ReproduceError
from studies.frame.pool import Job, run_jobs


@pytest.mark.parametrize("processes", [1, 2])
def test_results_come_in_the_order_of_the_jobs(processes: int) -> None:
    jobs = [Job(f"factorial {n}", math.factorial, (n,)) for n in (5, 3, 8, 1)]
    assert run_jobs(jobs, processes, Progress(disable=True), "factorials") == [120, 6, 40320, 1]


@pytest.mark.parametrize("processes", [1, 2])
def test_an_error_of_a_job_is_raised_by_its_kind(processes: int) -> None:
    jobs = [Job("tile", TileId, (-1,)), Job("fine", math.factorial, (2,))]
    with pytest.raises(Exception, match="tile id -1") as raised:
        run_jobs(jobs, processes, Progress(disable=True), "tiles")
    assert type(raised.value).__name__ == "TileError"


def test_a_file_that_cannot_be_read_is_told_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(FolderError, match=r"reading: .*No such file"):
        run_jobs([Job("reading", Path.read_bytes, (tmp_path / "missing",))], 1, Progress(disable=True), "files")


def test_a_worker_that_dies_is_told() -> None:
    with pytest.raises(ReproduceError, match="start again"):
        run_jobs([Job("end", os._exit, (3,)), Job("end", os._exit, (3,))], 2, Progress(disable=True), "ends")


def test_progress_is_shown() -> None:
    progress = Progress(disable=True)
    run_jobs([Job("a", math.factorial, (4,)), Job("b", math.factorial, (4,))], 2, progress, "all")
    assert [task.completed for task in progress.tasks] == [2]
