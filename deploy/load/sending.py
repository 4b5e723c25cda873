"""What a vehicle does with one report, as its outbox does: send, hear what is wanted, send that, hear the release."""

import threading
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final

from gnd.deploy.load.drives import KeptReport
from gnd.deploy.load.plan import Due
from gnd.deploy.load.shift import DistrictShift, shifted_district
from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.errors import BusError
from gnd.gnd_map.gaussian import Gaussians
from gnd.schemas.changes import ChangeAck
from gnd.schemas.errors import SchemaError
from gnd.schemas.keys import change_key, state_key
from gnd.schemas.packed import PackedGaussians
from gnd.schemas.report_id import deterministic_report_id
from gnd.schemas.report_states import ReportQuestion, ReportState, ReportStates
from gnd.vehicle_agent.link.outbox import FIRST_ASK_S, LONGEST_ASK_S
from gnd.vehicle_agent.link.sending import QUESTION_S, REQUEST_S
from gnd.vehicle_agent.report.packing import pack_measured

NS_PER_S: Final = 1_000_000_000
PATIENCE: Final = 3
"""So often a message is sent whose request has failed; each has tried for 20 s."""


@dataclass(slots=True)
class SenderAccount:
    """What became of one report; times in s of the machine's monotonic clock, 0.0: it did not come to that.

    Attributes:
        report_id: ULID.
        vehicle: name.
        due_s: when it was to be sent.
        sent_s: when its flags were sent.
        acked_s: when they were acknowledged.
        ack: status of that.
        word_s: when the vehicle heard what is wanted of it, or that nothing is.
        halves: how many second halves were sent and acknowledged.
        whole: whether the whole report was asked for, sent and acknowledged.
        released_s: when it was released or refused.
        status: the last word.
        questions: how often it was asked after.
        failed: why a message could not be delivered.
    """

    report_id: str
    vehicle: str
    due_s: float
    sent_s: float = 0.0
    acked_s: float = 0.0
    ack: str = ""
    word_s: float = 0.0
    halves: int = 0
    whole: bool = False
    released_s: float = 0.0
    status: str = ""
    questions: int = 0
    failed: str = ""

    @property
    def is_acknowledged(self) -> bool:
        """Whether the cloud has acknowledged it."""
        return self.ack in ("stored", "duplicate")

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


@dataclass(slots=True)
class Open:
    """A report on its way."""

    account: SenderAccount
    kept: KeptReport
    shift: DistrictShift
    key: str
    last_ns: int
    wanted: bytes = b""
    next_ask_s: float = 0.0


@dataclass(slots=True)
class SendingMeasured:
    """Second halves, coded once for each mask: their bytes are the same on every street.

    Attributes:
        bases: the maps of the kept drives by content hash.
    """

    bases: Mapping[bytes, Gaussians]
    _coded: dict[tuple[KeptReport, bytes], PackedGaussians] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def half(self, kept: KeptReport, wanted: bytes, report_id: str) -> bytes:
        """The encoded second half that answers a mask."""
        at = (kept, wanted)  # the very report: the same vehicle says other things of another map under the same id
        with self._lock:
            found = self._coded.get(at)
        if found is None:
            found = pack_measured(kept.whole, self.bases, wanted)
            with self._lock:
                self._coded[at] = found
        return replace(found, report_id=report_id).encode()


class Sender:
    """Sends the messages of many vehicles over one session. Safe in several threads.

    Args:
        bus: open.
        measured: makes second halves.
    """

    def __init__(self, bus: Bus, measured: SendingMeasured) -> None:
        self._bus, self._measured = bus, measured

    def first(self, one: Open) -> None:
        """Send the flags, until they are acknowledged."""
        packed = one.shift.packed(one.kept.packed, one.kept.bases)
        first_ns = one.last_ns - packed.length_ns
        body = replace(packed, report_id=one.account.report_id, vehicle=one.account.vehicle, first_ns=first_ns).encode()
        one.account.sent_s = time.monotonic()
        ack = self._delivered(one, body)
        if ack is not None:
            one.account.acked_s, one.account.ack = time.monotonic(), ack.status
            one.next_ask_s = one.account.acked_s + FIRST_ASK_S

    def half(self, one: Open) -> None:
        """Send the Gaussians that are wanted."""
        wanted, one.wanted = one.wanted, b""
        if self._delivered(one, self._measured.half(one.kept, wanted, one.account.report_id)) is not None:
            one.account.halves += 1
            one.next_ask_s = time.monotonic() + FIRST_ASK_S

    def whole(self, one: Open) -> None:
        """Send all of it, where the cloud cannot use the short form."""
        here = one.shift.whole(one.kept.whole)
        length_ns = here.last_ns - here.first_ns
        whole = replace(
            here,
            report_id=one.account.report_id,
            vehicle=one.account.vehicle,
            first_ns=one.last_ns - length_ns,
            last_ns=one.last_ns,
        )
        if self._delivered(one, whole.encode()) is not None:
            one.account.whole = True
            one.next_ask_s = time.monotonic() + FIRST_ASK_S

    def ask(self, vehicle: str, reports: list[Open]) -> tuple[ReportState, ...]:
        """Ask for the states of a vehicle's reports that had no answer."""
        for one in reports:
            one.account.questions += 1
            wait_s = min(LONGEST_ASK_S, FIRST_ASK_S * 2 ** min(one.account.questions, 8))
            one.next_ask_s = time.monotonic() + wait_s
        question = ReportQuestion(tuple(one.account.report_id for one in reports)).encode()
        try:
            answer = self._bus.request(state_key(vehicle), question, kind="change", timeout_s=QUESTION_S)
            return ReportStates.decode(answer).states
        except (BusError, SchemaError):
            return ()

    def _delivered(self, one: Open, body: bytes) -> ChangeAck | None:
        """The ack of a message; None: nobody has given one."""
        for _ in range(PATIENCE):
            try:
                ack = ChangeAck.decode(self._bus.request(one.key, body, kind="change", timeout_s=REQUEST_S))
            except (BusError, SchemaError) as error:
                one.account.failed = str(error)
                if self._bus.is_closed:
                    return None
                continue
            if ack.status == "quarantined":
                one.account.failed = ack.reason
                one.account.status = "quarantined"
            return ack
        return None


def opened(due: Due, kept: KeptReport, shift: DistrictShift, seed: int, vehicle: str, due_s: float) -> Open:
    """A report as it begins, under an id of its own, stamped as if its last scan had been just now."""
    last_ns = time.time_ns()
    t_ms = (last_ns - kept.packed.length_ns) // 1_000_000
    report_id = deterministic_report_id(
        t_ms, str(seed), vehicle, str(due.passage), str(due.street), kept.packed.report_id
    )
    key = change_key(kept.whole.layer, shifted_district(kept.whole.district, shift.districts))
    return Open(SenderAccount(report_id, vehicle, due_s), kept, shift, key, last_ns)
