"""The thread that empties the outbox: each report is sent until somebody acknowledges it.

A report in short goes in two messages: its flags, and then the Gaussians that the answer asks for. Where the cloud
cannot make sense of the short form, for whatever reason, the whole report follows: only what is refused whole is
refused.
"""

import logging
import threading
import time
from collections import Counter

from fleet_bus.bus import Bus
from fleet_bus.errors import BusClosed, MessageTooLarge, RequestRefused
from gnd_map.errors import CodecError
from schemas.changes import ChangeAck, ChangeReport
from schemas.errors import SchemaError
from vehicle_agent.errors import PackingError
from vehicle_agent.outbox import ANSWERS, Letter, Outbox
from vehicle_agent.packing import pack_measured

POLL_S = 0.2
REQUEST_S = 20.0
SHORT_TRIES = 2  # flags again, when another shard that has not heard them was asked to take their Gaussians

ACKNOWLEDGED = ("stored", "duplicate")

_log = logging.getLogger(__name__)


class SenderThread:
    """Sends what is due, oldest first, from its start to `close`; a failure never ends it."""

    def __init__(self, bus: Bus, outbox: Outbox) -> None:
        self.last_error = ""
        self.counts: Counter[str] = Counter()  # messages by form: flags, gaussians, whole
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
            self._record(letter, self._in_short(letter) or self._ask(letter, letter.body, "whole"))
        except BusClosed:
            self._stop.set()
        except (RequestRefused, MessageTooLarge) as error:
            self._outbox.answered(letter.report_id, "quarantined", str(error))
        except Exception as error:  # whatever it was: this thread is all that empties the outbox
            self._outbox.failed(letter, time.time_ns(), str(error))
            self.last_error = str(error)
            _log.warning("report %s not acknowledged: %s", letter.report_id, error)

    def _in_short(self, letter: Letter) -> ChangeAck | None:
        """The acknowledgement of a report sent in short; None: it is to be sent whole."""
        if not letter.packed:
            return None
        try:
            for _ in range(SHORT_TRIES):
                answers = self._two_halves(letter)
                if answers[-1].status in ACKNOWLEDGED:
                    return answers[-1]
                if len(answers) == 1 or answers[-1].status != "resend":
                    break
            reason = f"{answers[-1].status} {answers[-1].reason}"
        except (RequestRefused, MessageTooLarge, CodecError, SchemaError, PackingError) as error:
            reason = str(error)
        _log.warning("report %s goes whole: %s", letter.report_id, reason)
        return None

    def _two_halves(self, letter: Letter) -> list[ChangeAck]:
        """The answer to the flags, and where that asks for Gaussians the answer to these."""
        ack = self._ask(letter, letter.packed, "flags")
        if ack.status != "wanted":
            return [ack]
        report, bases = ChangeReport.decode(letter.body), self._outbox.bases_of(letter.report_id)
        return [ack, self._ask(letter, pack_measured(report, bases, ack.wanted).encode(), "gaussians")]

    def _ask(self, letter: Letter, payload: bytes, form: str) -> ChangeAck:
        self.counts[form] += 1
        return ChangeAck.decode(self._bus.request(letter.key, payload, kind="change", timeout_s=REQUEST_S))

    def _record(self, letter: Letter, ack: ChangeAck) -> None:
        """An acknowledgement counts for its own report only, and a whole report has nothing left to ask for."""
        if ack.status not in ANSWERS:
            raise SchemaError(f"report {letter.report_id} was sent whole and answered {ack.status!r}")
        if ack.status != "quarantined" and ack.report_id != letter.report_id:
            raise SchemaError(f"report {letter.report_id} was answered for report {ack.report_id}")
        self._outbox.answered(letter.report_id, ack.status, ack.reason)
