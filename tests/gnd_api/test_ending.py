"""A program of ours ends with its own status, whatever its threads do inside zenoh just then."""

import re
import signal
import subprocess
import sys
import time
from pathlib import Path

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


SIGNALLED = """
from gnd import ending
import os, signal, subprocess, sys, threading, time

ending.catch_signals()

def main():
    with ending.working():
        try:
            body()
        except KeyboardInterrupt:
            print("closed", flush=True)
            sys.exit(ending.exit_code())

def ready():
    print("ready", flush=True)

"""
RUN = "\nending.run_program(main)\n"
CASES = {
    "raises": "ready(); time.sleep(60)",
    "a thread that never ends": "threading.Thread(target=time.sleep, args=(60,)).start(); ready(); time.sleep(60)",
    "a handler of its own": (
        "stop = threading.Event(); signal.signal(signal.SIGINT, lambda *_: stop.set());"
        " signal.signal(signal.SIGTERM, lambda *_: stop.set()); ready(); stop.wait(60); print('closed', flush=True);"
        " sys.exit(ending.exit_code())"
    ),
}
DEAF = "signal.signal(signal.SIGINT, lambda *_: None); signal.signal(signal.SIGTERM, lambda *_: None); ready(); "
DEAF += "\n    while True: time.sleep(1)"


def signalled(body: str, *more: str) -> "subprocess.Popen[str]":
    program = SIGNALLED + f"def body():\n    {body}\n" + "".join(more) + RUN
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("case", sorted(CASES))
def test_a_signal_lets_a_program_close_what_it_opened_and_then_waits_for_nobody(case, number):
    process = signalled(CASES[case])
    process.send_signal(number)
    written, errors = process.communicate(timeout=30)
    assert (process.returncode, written, errors) == (128 + number, "closed\n", "")


def test_a_program_that_does_not_end_is_killed_after_the_grace_with_its_helpers():
    helper = "import time; time.sleep(100)"
    # The helper has the same output: communicate returns only when it has ended, too.
    process = signalled(f"helper = subprocess.Popen([sys.executable, '-c', {helper!r}]); {DEAF}")
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=30)
    assert (process.returncode, errors) == (143, "gnd: interrupted\n")


def test_helpers_end_with_a_program_that_is_interrupted():
    process = signalled(
        "helper = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(100)']);"
        " print('ready'); print(helper.pid, flush=True); time.sleep(60)"
    )
    assert process.stdout is not None
    pid = int(process.stdout.readline())
    assert Path(f"/proc/{pid}").exists()
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=30)
    assert process.returncode == 130
    _gone(pid)


def _gone(pid: int) -> None:
    deadline_s = time.monotonic() + 10
    while time.monotonic() < deadline_s:
        try:
            state = re.search(r"^State:\s*(\w)", Path(f"/proc/{pid}/status").read_text(), re.M)
        except OSError:
            return
        if state is not None and state[1] == "Z":
            return
        time.sleep(0.02)
    pytest.fail(f"process {pid} is still there")


def test_the_second_signal_ends_at_once_what_has_something_to_put_in_order():
    process = signalled(f"ending._grace_s[0] = ending.ORDERLY_S; {DEAF}")
    process.send_signal(signal.SIGINT)
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(ENDS_LATER_S)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=10)
    assert process.returncode == 130


ENDS_LATER_S = 4.0
"""Longer than the grace of a command that has nothing to put in order."""


def test_while_modules_are_imported_a_signal_ends_at_once_and_says_so():
    process = signalled("with ending.ending_at_once(): ready(); time.sleep(60)")
    process.send_signal(signal.SIGTERM)
    written, errors = process.communicate(timeout=30)
    assert (process.returncode, written, errors) == (143, "", "gnd: interrupted\n")


def test_a_signal_that_was_ignored_at_the_start_stays_ignored():
    program = SIGNALLED + "def body():\n    ready(); time.sleep(1.5); print('done')\n" + RUN
    wrapped = f"trap '' INT; exec {sys.executable} -c \"$0\""
    process = subprocess.Popen(["sh", "-c", wrapped, program], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    process.send_signal(signal.SIGINT)
    written, _ = process.communicate(timeout=30)
    assert (process.returncode, written) == (0, "done\n")


def test_a_fork_has_its_signals_to_itself():
    child = "signal.signal(signal.SIGTERM, signal.SIG_DFL); time.sleep(60)"
    process = signalled(
        f"child = os.fork()\n    if not child:\n        {child}\n"
        "    time.sleep(0.3); os.kill(child, signal.SIGTERM); os.waitpid(child, 0); ready()\n"
        "    time.sleep(3.5); print('on')"
    )
    written, errors = process.communicate(timeout=30)
    assert (process.returncode, written, errors) == (0, "on\n", "")


def test_processes_started_while_ctrl_c_is_withheld_never_get_it():
    process = signalled(
        "with ending.ctrl_c_withheld(): helper = subprocess.Popen([sys.executable, '-c',"
        " 'import time; time.sleep(1.5); print(1, flush=True)'])\n"
        "    os.kill(helper.pid, signal.SIGINT); ready(); sys.exit(helper.wait())"
    )
    written, errors = process.communicate(timeout=30)
    assert (process.returncode, written, errors) == (0, "1\n", "")


def test_an_exception_comes_after_an_import_that_would_swallow_it(tmp_path):
    (tmp_path / "swallows.py").write_text(
        "import time\nprint('ready', flush=True)\nend_s = time.monotonic() + 1.0\n"
        "try:\n    while time.monotonic() < end_s:\n        pass\n"
        "except BaseException as error:\n    raise ImportError('initialization failed') from error\n"
    )
    process = signalled(f"sys.path.insert(0, {str(tmp_path)!r}); import swallows; time.sleep(60)")
    process.send_signal(signal.SIGINT)
    written, errors = process.communicate(timeout=30)
    assert (process.returncode, written, errors) == (130, "closed\n", "")


def test_what_is_to_be_put_in_order_is_while_modules_are_imported_too():
    process = signalled("with ending.orderly(), ending.ending_at_once(): ready(); time.sleep(60)")
    process.send_signal(signal.SIGTERM)
    written, errors = process.communicate(timeout=30)
    assert (process.returncode, written, errors) == (143, "closed\n", "")
