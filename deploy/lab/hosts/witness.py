"""The witness: a third host that remembers which database host may take writes, and whether it may do so alone.

Each database host asks before it goes on without the other. As only one of them is ever told yes, what one
acknowledged alone cannot be missing at the other. A question is a line "who", "promote NAME", "alone NAME" or "paired
NAME"; the answer is a line of JSON.
"""

import json
import os
import socket
import socketserver
import threading
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

from gnd.deploy.errors import LabError
from gnd.fleet_bus.router import wait_for_stop

LONGEST_LINE_BYTES: Final = 256
ASK_TIMEOUT_S: Final = 0.5


@dataclass(frozen=True, slots=True)
class WitnessState:
    """What the witness remembers.

    Attributes:
        primary: who takes writes.
        is_alone: whether it may do so without the other; then the other must not take over.
    """

    primary: str
    is_alone: bool = True

    def after(self, word: str, name: str) -> tuple["WitnessState", bool]:
        """The state after a question, and whether it is granted.

        Raises:
            LabError: no such question.
        """
        is_primary = name == self.primary
        if word == "who":
            return self, True
        if word == "promote":
            granted = is_primary or not self.is_alone
            return (WitnessState(name), True) if granted else (self, False)
        if word in ("alone", "paired"):
            return (replace(self, is_alone=word == "alone"), True) if is_primary else (self, False)
        raise LabError(f"a witness is not asked {word!r}")


class _WitnessServer(socketserver.ThreadingTCPServer):
    allow_reuse_address, daemon_threads = True, True

    def __init__(self, address: tuple[str, int], file: Path, first: str) -> None:
        super().__init__(address, _WitnessHandler)
        self._file, self._lock = file, threading.Lock()
        self._state = WitnessState(**json.loads(file.read_text())) if file.exists() else WitnessState(first)

    def answer(self, line: str) -> dict[str, Any]:
        word, _, name = line.strip().partition(" ")
        with self._lock:
            state, granted = self._state.after(word, name)
            if state != self._state:
                self._keep(state)
            return asdict(state) | {"granted": granted}

    def _keep(self, state: WitnessState) -> None:
        """On the disk before it is told."""
        partial = self._file.with_suffix(".partial")
        with partial.open("w", encoding="utf-8") as file:
            file.write(json.dumps(asdict(state)))
            file.flush()
            os.fsync(file.fileno())
        partial.replace(self._file)
        self._state = state


class _WitnessHandler(socketserver.StreamRequestHandler):
    timeout = 2.0
    server: _WitnessServer

    def handle(self) -> None:
        """One question."""
        try:
            told = self.server.answer(self.rfile.readline(LONGEST_LINE_BYTES).decode("ascii", "replace"))
        except LabError as error:
            told = {"error": str(error)}
        self.wfile.write(json.dumps(told).encode() + b"\n")


def witness(address: tuple[str, int], file: Path, first: str, *, stop: threading.Event) -> None:
    """Answer until `stop` is set; the role of a process.

    Args:
        address: to listen at.
        file: what is remembered, also over the end of this process.
        first: who takes writes where nothing is remembered.
        stop: ends it.
    """
    with _WitnessServer(address, file, first) as server:
        thread = threading.Thread(target=server.serve_forever, name="witness", daemon=True)
        thread.start()
        wait_for_stop(stop)
        server.shutdown()
        thread.join()


@dataclass(frozen=True, slots=True)
class WitnessClient:
    """Asks the witness for one of the database hosts.

    Attributes:
        address: of the witness; None: there is none, and nothing is ever granted.
        name: who asks.
    """

    address: tuple[str, int] | None
    name: str

    def who(self) -> WitnessState | None:
        """What it remembers; None: it does not answer."""
        told = self._ask("who")
        return None if told is None else WitnessState(told["primary"], told["is_alone"])

    def grants(self, word: str) -> bool:
        """Whether it says yes to "promote", "alone" or "paired"."""
        told = self._ask(word)
        return told is not None and bool(told["granted"])

    def _ask(self, word: str) -> dict[str, Any] | None:
        if self.address is None:
            return None
        try:
            with socket.create_connection(self.address, ASK_TIMEOUT_S) as connection:
                connection.sendall(f"{word} {self.name}\n".encode())
                with connection.makefile("rb") as file:
                    told: dict[str, Any] = json.loads(file.readline(LONGEST_LINE_BYTES))
        except (OSError, ValueError):
            return None
        return told if "granted" in told else None
