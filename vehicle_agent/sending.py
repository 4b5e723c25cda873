"""The thread that empties the outbox: each report is sent until somebody acknowledges it."""

import logging
import threading
import time

from fleet_bus.bus import Bus
from fleet_bus.errors import BusClosed, MessageTooLarge, RequestRefused
from schemas.changes import ChangeAck
from schemas.errors import SchemaError
from vehicle_agent.outbox import Letter, Outbox

POLL_S = 0.2
REQUEST_S = 20.0

_log = logging.getLogger(__name__)


class SenderThread:
    """Sends what is due, oldest first, from its start to `close`; a failure never ends it."""

    def __init__(self, bus: Bus, outbox: Outbox) -> None:
        self.last_error = ""
        self._bus, self._outbox = bus, outbox
        self._stop = threading.Event()
        outbox.retry_now()  # what an earlier life of this agent left here goes first
        self._thread = threading.Thread(target=self._run, name="outbox", daemon=True)
        self._thread.start()

    def drain(self, timeout_s: float, stop: threading.Event) -> bool:
        """Wait until nothing is pending; False when time is up or `stop` is set."""
        deadline_s = time.monotonic() + timeout_s
        while self._outbox.counts().pending:
            if time.monotonic() > deadline_s or stop.wait(POLL_S):
                return False
        return True

    def close(self) -> None:
        """End the thread; a request under way ends with the bus or its deadline."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.is_set():
            letters = self._outbox.due(time.time_ns())
            for letter in letters:
                if self._stop.is_set():
                    return
                self._send(letter)
            if not letters:
                self._stop.wait(POLL_S)

    def _send(self, letter: Letter) -> None:
        try:
            answer = self._bus.request(letter.key, letter.body, kind="change", timeout_s=REQUEST_S)
            self._record(letter, ChangeAck.decode(answer))
        except BusClosed:
            self._stop.set()
        except (RequestRefused, MessageTooLarge) as error:
            self._outbox.answered(letter.report_id, "quarantined", str(error))
        except Exception as error:  # whatever it was: this thread is all that empties the outbox
            self._outbox.failed(letter, time.time_ns(), str(error))
            self.last_error = str(error)
            _log.warning("report %s not acknowledged: %s", letter.report_id, error)

    def _record(self, letter: Letter, ack: ChangeAck) -> None:
        """An acknowledgement counts for its own report only."""
        if ack.status != "quarantined" and ack.report_id != letter.report_id:
            raise SchemaError(f"report {letter.report_id} was answered for report {ack.report_id}")
        self._outbox.answered(letter.report_id, ack.status, ack.reason)
