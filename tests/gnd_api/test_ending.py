"""A program of ours ends with its own status, whatever its threads do inside zenoh just then."""

import subprocess
import sys

import pytest

BEGIN = """
from gnd.ending import run_program
import atexit, sys, threading, time, zenoh

def main():
    atexit.register(lambda: print("registered by another"))
    print("written before the end")
"""
BUSY = """
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    session = zenoh.open(config)
    def put():
        while True:
            session.put("a/b", b"x")
    for _ in range(4):
        threading.Thread(target=put, daemon=True).start()
    time.sleep(0.2)
"""
WRITTEN = "written before the end\nregistered by another\n"


def run(*lines: str) -> "subprocess.Popen[str]":
    program = BEGIN + "".join(lines) + "\nrun_program(main)\n"
    return subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_threads_inside_zenoh_do_not_abort_the_end():
    for process in [run(BUSY, "    sys.exit(3)\n") for _ in range(8)]:
        written, errors = process.communicate(timeout=60)
        assert (process.returncode, written, errors) == (3, WRITTEN, "")


@pytest.mark.parametrize(
    ("end", "status", "error"),
    [
        ("", 0, ""),
        ("    sys.exit()\n", 0, ""),
        ("    sys.exit(259)\n", 3, ""),
        ("    sys.exit('a word')\n", 1, "a word"),
        ("    1 / 0\n", 1, "ZeroDivisionError"),
    ],
)
def test_the_status_is_that_of_the_program(end, status, error):
    process = run(end)
    written, errors = process.communicate(timeout=60)
    assert (process.returncode, written) == (status, WRITTEN)
    assert error in errors
