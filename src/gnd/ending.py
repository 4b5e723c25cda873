"""The end of a program: at once on Ctrl-C and SIGTERM, and by the system's own exit, once everything is written.

A thread that comes back from zenoh while the interpreter is being taken down is ended by force inside zenoh's frames,
and the whole process aborts with "FATAL: exception not rethrown" and status -6 although its work was done. So a program
of ours is not taken down: when its threads have ended and what others registered for the end has run, it exits.

Signals (decision 177). Until a command works, a signal ends the process at once: nothing is to be put in order. Then it
raises KeyboardInterrupt (a moment later where an import or a compiler is interrupted, which would swallow it), unless
the command has a handler of its own. A thread watches beside: where the end takes
longer than the grace, or at the second signal, what is left of the program and its helpers is killed. Its exit code is
130 after Ctrl-C and 143 after SIGTERM.

Import this module before others: what is registered first runs last.
"""

import atexit
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Final

ENDING_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)
GRACE_S: Final = 2.5
"""A command that has nothing to put in order is killed so long after the first signal."""
ORDERLY_S: Final = 25.0
"""One that has (`orderly`) is killed so long after it; it is meant to need a second."""
_FAILED: Final = 1
_COMPILER: Final = "llvmlite"
_IMPORTING: Final = "<frozen importlib"
_AGAIN_S: Final = 0.02
_NOTED_IN_S: Final = 0.5
_TRACKER: Final = b"resource_tracker"
"""A helper of multiprocessing that cleans up after others, and ends by itself."""

_status: int | None = None
_signalled: list[int] = []
_watched = threading.Event()
_noted = threading.Event()
_at_once: list[bool] = [True]
_grace_s: list[float] = [GRACE_S]


def catch_signals() -> None:
    """Take Ctrl-C and SIGTERM from now on; called once, in the main thread, before anything heavy is imported.

    A signal that was ignored when the process was started stays ignored, as is the custom (`nohup`, `… &`).
    """
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    for number in ENDING_SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    os.register_at_fork(after_in_child=_forget)
    _watched.set()
    threading.Thread(target=_watch, args=(reader,), name="ending", daemon=True).start()


def exit_code() -> int:
    """Exit code of a program that a signal ends: 130 after Ctrl-C, 143 after SIGTERM.

    Where the program has a handler of its own, the thread that watches notes the signal, perhaps a moment later.
    """
    if _watched.is_set():
        _noted.wait(_NOTED_IN_S)
    return 128 + (_signalled[0] if _signalled else signal.SIGINT)


@contextmanager
def orderly(within_s: float = ORDERLY_S) -> Iterator[None]:
    """The command has something to put in order: on the first signal it gets more time, the second ends it at once.

    Args:
        within_s: so long after the first signal it is killed.
    """
    before, _grace_s[0] = _grace_s[0], within_s
    try:
        yield
    finally:
        _grace_s[0] = before


@contextmanager
def ending_at_once() -> Iterator[None]:
    """A signal within the block ends the process without more ado: while modules are imported. Not where there is
    something to put in order.
    """
    before, _at_once[0] = _at_once[0], _grace_s[0] == GRACE_S
    try:
        yield
    finally:
        _at_once[0] = before


@contextmanager
def working() -> Iterator[None]:
    """A signal within the block raises KeyboardInterrupt, so that what is open is closed."""
    before, _at_once[0] = _at_once[0], False
    try:
        yield
    finally:
        _at_once[0] = before


@contextmanager
def ctrl_c_withheld() -> Iterator[None]:
    """Processes that this thread starts within the block never get Ctrl-C, which a terminal sends to all: who started
    them ends them. To be used in the thread that starts them; its own Ctrl-C waits until the end of the block.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT,))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def run_program(main: Callable[[], None]) -> None:
    """Run a program's main function and let the process exit with its status as soon as it is over.

    Raises:
        SystemExit: with the status; whatever else `main` raises.
    """
    global _status  # noqa: PLW0603 - one end a process
    _status = _FAILED
    try:
        main()
    except SystemExit as end:
        _status = _number_of(end.code)
        if not _signalled:
            raise
    except KeyboardInterrupt:
        _status = exit_code()
        if not _signalled:
            raise
    except SystemError as error:
        if not (_signalled and _is_interrupted(error)):
            raise
        _status = exit_code()
        _say_interrupted()
    else:
        _status = 0
    if _signalled:  # as at the end of the interpreter, but nobody waits for threads
        kill_descendants()
        atexit._run_exitfuncs()


def _is_interrupted(error: BaseException | None) -> bool:
    """Whether it comes from a KeyboardInterrupt: what is written in C may answer one with an error of its own."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _end(number: int, frame: FrameType | None) -> None:
    _note(number)
    if _at_once[0]:
        _say_interrupted()
        _exit_now(exit_code())
    if _must_not_raise(frame):
        signal.signal(signal.SIGALRM, lambda _number, later: _end(number, later))
        signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
        return
    raise KeyboardInterrupt


def _must_not_raise(frame: FrameType | None) -> bool:
    """Whether an exception would be lost or changed where the program was interrupted.

    Functions that LLVM calls give none back. A module in C++ that is being imported makes an ImportError of it.
    """
    while frame is not None:
        code = frame.f_code
        if code.co_filename.startswith(_IMPORTING) or (_COMPILER in code.co_filename and code.co_name[:5] == "_raw_"):
            return True
        frame = frame.f_back
    return False


def _note(number: int) -> None:
    if not _signalled:
        _signalled.append(number)
    _noted.set()


def _watch(reader: int) -> None:
    """Wait for the first signal, also while the main thread computes; then see to it that the process ends."""
    first = _next_signal(reader)
    _note(first)
    second = threading.Event()

    def listen() -> None:
        _next_signal(reader)
        second.set()

    threading.Thread(target=listen, name="second signal", daemon=True).start()
    second.wait(_grace_s[0])
    _say_interrupted()
    _exit_now(exit_code())


def _next_signal(reader: int) -> int:
    while data := os.read(reader, 1):
        if data[0] in ENDING_SIGNALS and signal.getsignal(data[0]) is not signal.SIG_IGN:
            return data[0]
    raise OSError("the pipe of signals is closed")


def _forget() -> None:
    """In a child of a fork: its signals are its own."""
    _watched.clear()
    with suppress(ValueError):
        signal.set_wakeup_fd(-1)


def _say_interrupted() -> None:
    with suppress(OSError):
        os.write(2, b"gnd: interrupted\n")


def _exit_now(status: int) -> None:
    """Exit without waiting for threads; helpers that are still there are killed."""
    _flush()
    kill_descendants()
    os._exit(status)


def kill_descendants() -> None:
    """Kill the processes that this one has started, and theirs (Linux; elsewhere they notice that it is gone)."""
    for pid in _descendants(os.getpid()):
        with suppress(OSError):
            os.kill(pid, signal.SIGKILL)


def _descendants(root: int) -> list[int]:
    children: dict[int, list[int]] = {}
    with suppress(OSError):
        for name in os.listdir("/proc"):  # noqa: PTH208 - no more than what is needed is imported here
            if name.isdecimal() and (parent := _parent(name)) is not None:
                children.setdefault(parent, []).append(int(name))
    found, waiting = [], [root]
    while waiting:
        for pid in children.get(waiting.pop(), ()):
            found.append(pid)
            waiting.append(pid)
    return found


def _parent(pid: str) -> int | None:
    """Parent of a process; None of one that has gone or is to be left alone."""
    try:
        with open(f"/proc/{pid}/stat", "rb") as stat, open(f"/proc/{pid}/cmdline", "rb") as words:  # noqa: PTH123
            if _TRACKER in words.read():
                return None
            return int(stat.read().rpartition(b")")[2].split()[1])
    except (OSError, ValueError, IndexError):
        return None


def _number_of(code: object) -> int:
    """Status of a process that ends with this code, by the rules of `sys.exit`."""
    if code is None:
        return 0
    return code & 0xFF if isinstance(code, int) else _FAILED


def _flush() -> None:
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):  # whoever read it has gone, or it was closed
            stream.flush()


def _exit() -> None:
    if _status is None:
        return
    _flush()
    os._exit(_status)


atexit.register(_exit)
