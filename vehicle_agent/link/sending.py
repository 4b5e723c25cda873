"""The thread that empties the outbox: each report is sent until it is acknowledged, and kept until it is released.

A report in short goes in two messages: its flags, and then the Gaussians that the cloud asks for. It asks on the
vehicle's own key once it has looked at the flags; where no word comes, the vehicle asks after its reports. A few
Gaussians come with the flags, and word that such a report is released with the ack of the next one. Where the
cloud cannot make sense of the short form, for whatever reason, the whole report follows: only what is refused whole is
refused.
"""

import logging
import random
import threading
import time
from collections import Counter

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.errors import BusClosed, MessageTooLarge, RequestFailed, RequestRefused
from gnd.fleet_bus.requesting import BUSY_SPREAD
from gnd.gnd_map.errors import CodecError, GndError
from gnd.schemas.changes import ChangeAck, ChangeReport
from gnd.schemas.errors import SchemaError
from gnd.schemas.keys import state_key, want_key
from gnd.schemas.report_states import ReportQuestion, ReportState, ReportStates
from gnd.schemas.upload_head import head_of_upload
from gnd.vehicle_agent.errors import PackingError
from gnd.vehicle_agent.link.outbox import ANSWERS, FIRST_ASK_S, PATIENT_ASK_S, Letter, Outbox
from gnd.vehicle_agent.report.packing import pack_measured

POLL_S = 0.2
REQUEST_S = 20.0
QUESTION_S = 5.0
STORE_PAUSE_S = 1.0

_log = logging.getLogger(__name__)


class SenderThread:
    """Sends what is due, oldest first, from its start to `close`; a failure never ends it.

    Args:
        bus: open.
        outbox: what is to be sent.
        vehicle: its pseudonym, whose key tells what is wanted.
    """

    def __init__(self, bus: Bus, outbox: Outbox, vehicle: str) -> None:
        self.last_error = ""
        self.counts: Counter[str] = Counter()  # messages by form: flags, gaussians, whole, questions
        self._bus, self._outbox, self._vehicle = bus, outbox, vehicle
        self._stop, self._wake = threading.Event(), threading.Event()
        # What an earlier life of this agent left here goes first; and its waits are times of a clock that begins anew
        # with the machine. It never steps: a date that is set back keeps no report from going.
        outbox.retry_now()
        bus.subscribe(want_key(vehicle), self._on_notice, kind="ack")
        self._thread = threading.Thread(target=self._run, name="outbox", daemon=True)
        self._thread.start()

    def drain(self, timeout_s: float, stop: threading.Event) -> bool:
        """Wait until all is released or refused; False when time is up or `stop` is set."""
        deadline_s, asks_soon = time.monotonic() + timeout_s, False
        while (counts := self._outbox.counts()).open:
            if not counts.pending and not asks_soon:
                asks_soon = True
                self._outbox.ask_soon(time.monotonic_ns())
            if time.monotonic() > deadline_s or stop.wait(POLL_S):
                return False
        return True

    def close(self) -> None:
        """End the thread; a request under way ends with the bus or its deadline."""
        self._stop.set()
        self._wake.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._round()
            except Exception as error:  # a full disk: not even the failure can be recorded, nothing can be sent
                self.last_error = str(error)
                _log.warning("the outbox cannot be used, next try in %g s: %s", STORE_PAUSE_S, error)
                self._stop.wait(STORE_PAUSE_S)

    def _round(self) -> None:
        """Send what is due; without any, ask after what is held, or wait. Raises OutboxError."""
        self._wake.clear()
        letters = self._outbox.due(time.monotonic_ns())
        for letter in letters:
            if self._stop.is_set():
                return
            self._send(letter)
        if not letters and not self._ask_after():
            self._wake.wait(POLL_S)

    def _send(self, letter: Letter) -> None:
        try:
            self._record(letter, *self._asked(letter))
        except BusClosed:
            self._stop.set()
        except (RequestRefused, MessageTooLarge) as error:
            self._refused(letter, str(error))
        except (CodecError, PackingError) as error:  # no Gaussians can be made of what the outbox holds
            self._go_whole(letter, str(error))
        except RequestFailed as error:
            self._failed(letter, error)
        except Exception as error:  # whatever it was: this thread is all that empties the outbox
            self._outbox.failed(letter, time.monotonic_ns(), str(error))
            self.last_error = str(error)
            _log.warning("report %s not acknowledged: %s", letter.report_id, error)

    def _failed(self, letter: Letter, error: RequestFailed) -> None:
        """Where the cloud says that it is busy, nothing else of this vehicle is sent before that time is over."""
        wait_s = error.retry_after_s * random.uniform(1.0, BUSY_SPREAD)
        self._outbox.failed(letter, time.monotonic_ns(), str(error), wait_s)
        self.last_error = str(error)
        _log.warning("report %s not acknowledged: %s", letter.report_id, error)
        self._stop.wait(wait_s)

    def _asked(self, letter: Letter) -> tuple[ChangeAck, str]:
        """The answer to the next message of a report, and its form."""
        payload, form = letter.body, "whole"
        if letter.wanted:
            report, bases = ChangeReport.decode(letter.body), self._outbox.bases_of(letter.report_id)
            payload, form = pack_measured(report, bases, letter.wanted).encode(), "gaussians"
        elif letter.packed:
            payload, form = letter.packed, "flags"
        self.counts[form] += 1
        return ChangeAck.decode(self._bus.request(letter.key, payload, kind="change", timeout_s=REQUEST_S)), form

    def _record(self, letter: Letter, ack: ChangeAck, form: str) -> None:
        """An acknowledgement counts for its own report only, and a whole report has nothing left to ask for."""
        is_unnamed = not ack.report_id and self._bus.binds_answers  # its seal has shown what it answers
        if ack.status != "quarantined" and ack.report_id != letter.report_id and not is_unnamed:
            raise SchemaError(f"report {letter.report_id} was answered for report {ack.report_id or 'without an id'}")
        if form == "whole" and ack.status not in ANSWERS:
            raise SchemaError(f"report {letter.report_id} was sent whole and answered {ack.status!r}")
        for state in ack.told:
            self._outbox.told(state, time.monotonic_ns())
        if ack.status == "wanted":
            self._outbox.told(ReportState(letter.report_id, "wanted", ack.wanted), time.monotonic_ns())
        elif ack.status in ("quarantined", "resend"):
            self._refused(letter, ack.reason)
        else:
            is_patient = form == "flags" and head_of_upload(letter.packed).is_patient
            self._outbox.answered(
                letter.report_id,
                ack.status,
                now_ns=time.monotonic_ns(),
                wanted=letter.wanted,
                is_short=form != "whole",
                ask_s=PATIENT_ASK_S if is_patient else FIRST_ASK_S,
            )

    def _refused(self, letter: Letter, reason: str) -> None:
        """Only a whole report is refused for good."""
        if letter.packed or letter.wanted:
            self._go_whole(letter, reason)
        else:
            self._outbox.answered(letter.report_id, "quarantined", reason)

    def _go_whole(self, letter: Letter, reason: str) -> None:
        _log.warning("report %s goes whole: %s", letter.report_id, reason)
        self._outbox.send_whole(letter.report_id, reason)

    def _on_notice(self, _key: str, payload: bytes) -> None:
        self._hear(ReportStates.decode(payload))

    def _hear(self, states: ReportStates) -> None:
        for state in states.states:
            self._outbox.told(state, time.monotonic_ns())
        self._wake.set()

    def _ask_after(self) -> bool:
        """Ask after reports of which no word has come; False when there are none."""
        try:
            report_ids = self._outbox.unheard(time.monotonic_ns())
            if not report_ids:
                return False
            self._outbox.asked(report_ids, time.monotonic_ns())
            self.counts["questions"] += 1
            question = ReportQuestion(tuple(report_ids)).encode()
            answer = self._bus.request(state_key(self._vehicle), question, kind="change", timeout_s=QUESTION_S)
            self._hear(ReportStates.decode(answer))
        except BusClosed:
            self._stop.set()
        except GndError as error:
            self.last_error = str(error)
            _log.warning("nothing heard of stored reports: %s", error)
            self._stop.wait(POLL_S)
        return True
