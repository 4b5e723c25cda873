"""Which deaths of a process the supervisor takes for a crash loop."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from gnd.deploy import processes
from gnd.deploy.errors import ProcessDied
from gnd.deploy.processes import MAX_RESTARTS, ProcessSpec, Supervisor, start_fork_server
from gnd.fleet_bus.router import wait_for_stop

POLL_S, PATIENCE_S = 0.02, 60.0


def living(*, stop: threading.Event) -> None:
    wait_for_stop(stop)


def dying(*, stop: threading.Event) -> None:
    raise RuntimeError("it dies at once")


@pytest.fixture
def supervisor(tmp_path: Path) -> Iterator[Supervisor]:
    start_fork_server()
    supervisor = Supervisor(tmp_path, tmp_path / "pids.json")
    yield supervisor
    supervisor.stop()


def poll_until(supervisor: Supervisor, restarts: int, name: str) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while supervisor.restarts.get(name, 0) < restarts:
        supervisor.poll()
        assert time.monotonic() < end_s
        time.sleep(POLL_S)


def test_a_process_that_is_killed_on_purpose_is_started_again_as_often_as_that(supervisor: Supervisor) -> None:
    supervisor.start(ProcessSpec("part", living, ()))
    for kills in range(1, MAX_RESTARTS + 4):
        supervisor.kill("part")
        poll_until(supervisor, kills, "part")
    assert supervisor.restarts == {"part": MAX_RESTARTS + 3}
    assert supervisor.deaths["part"] == 0


def test_a_process_that_dies_by_itself_again_and_again_is_given_up(
    supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "RESTART_DELAY_S", 0.01)
    supervisor.start(ProcessSpec("part", dying, ()))
    with pytest.raises(ProcessDied, match=f"part ended {MAX_RESTARTS + 1} times within 60 s"):
        poll_until(supervisor, 99, "part")
    assert supervisor.restarts == {"part": MAX_RESTARTS}
    assert supervisor.deaths["part"] == MAX_RESTARTS + 1


def test_deaths_of_long_ago_count_no_more(supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "RESTART_DELAY_S", 0.01)
    monkeypatch.setattr(processes, "RESTARTS_SPAN_S", 0.0)
    supervisor.start(ProcessSpec("part", dying, ()))
    poll_until(supervisor, MAX_RESTARTS + 2, "part")
