"""Ports of tests that run side by side: none twice, in whatever process."""

import socket
import subprocess
import sys
from pathlib import Path

from suite_ports import BLOCK, is_ours, new_port

MANY = 3
ASK = f"from suite_ports import new_port; print(*(new_port() for _ in range({2 * BLOCK + 5})), flush=True); input()"


def test_processes_get_different_ports_while_they_run() -> None:
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", ASK],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parent,
        )
        for _ in range(MANY)
    ]  # fmt: skip
    given = [process.stdout.readline().split() for process in processes if process.stdout is not None]
    for process in processes:
        process.communicate("\n")
    assert len({port for ports in given for port in ports}) == MANY * (2 * BLOCK + 5)


def test_a_block_belongs_to_one_and_a_port_with_a_listener_to_nobody() -> None:
    first = new_port()
    assert not is_ours(first - first % BLOCK)
    with socket.create_server(("127.0.0.1", first + 1)):
        assert new_port() > first + 1
