"""Vehicles hear how far their reports have come: told once when it is known, and answered whenever they ask.

Where several stores share a map, each shard answers for the reports that its store holds. That a report is known to
nobody is said late, so that who knows it comes first.
"""

import logging
import time
from typing import Final

from gnd.cloud_merger.patience import PatientWords
from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.errors import BusError, Refused
from gnd.fleet_bus.serving import Request, Serving
from gnd.schemas.errors import SchemaError
from gnd.schemas.keys import parse_state_key, state_keys, want_key
from gnd.schemas.report_states import ReportQuestion, ReportState, ReportStates, ReportStatus
from gnd.tile_store.store import Store
from gnd.tile_store.uploads import UploadState

STATUS: Final[dict[UploadState, ReportStatus]] = {
    "waiting": "waiting",
    "early": "waiting",
    "wanted": "wanted",
    "released": "released",
    "resend": "resend",
    "quarantined": "quarantined",
}
UNKNOWN_AFTER_S: Final = 0.5
"""Where several stores share a map, "unknown" is said after so long."""
WORKERS: Final = 2
WORKERS_OF_SEVERAL: Final = 8
"""Threads that answer; in the second case some of them wait."""
_LOG = logging.getLogger(__name__)


class States:
    """Tells and answers; what it says is read from the store, so any shard may be asked.

    Args:
        store: of the uploads.
        bus: open.
        words: those that wait for an ack.
    """

    def __init__(self, store: Store, bus: Bus, words: PatientWords | None = None) -> None:
        self._store, self._bus, self._words = store, bus, words or PatientWords()
        self._serving: Serving | None = None
        self._are_several = False

    def open(self, *, are_several: bool = False) -> None:
        """Begin to answer, alone or as one of several stores' shards; go on where that is as it was."""
        if self._serving is not None and are_several == self._are_several:
            return
        before, self._are_several = self._serving, are_several
        workers = WORKERS_OF_SEVERAL if are_several else WORKERS
        self._serving = self._bus.serve(
            state_keys(), self._answer, complete=not are_several, workers=workers, kind="change"
        )
        if before is not None:
            before.retire()  # what has come to it is answered

    def tell(self, vehicle: str, state: ReportState) -> None:
        """Put a notice on the vehicle's key, with what waits for it; or keep it for an ack (`PatientWords`)."""
        if not self._words.keep(vehicle, state):
            self._put(vehicle, (*self._words.take(vehicle), state))

    def tell_kept(self) -> None:
        """Tell what has waited long enough."""
        for vehicle, states in self._words.due():
            self._put(vehicle, states)

    def _put(self, vehicle: str, states: tuple[ReportState, ...]) -> None:
        """A notice that is lost is asked for."""
        try:
            self._bus.publish(want_key(vehicle), ReportStates(states).encode(), kind="ack", wait_s=0.0)
        except (BusError, SchemaError) as error:
            last = states[-1]
            _LOG.info("%s is not told that %s is %s: %s", vehicle, last.report_id, last.status, error)

    def _answer(self, request: Request) -> bytes:
        try:
            if self._are_several:
                known = answer_of_known(self._store, request.key, request.payload)
                if known is not None:
                    return known
                time.sleep(UNKNOWN_AFTER_S)
            return answer(self._store, request.key, request.payload)
        except SchemaError as error:
            raise Refused(str(error)) from error


def answer(store: Store, key: str, payload: bytes) -> bytes:
    """The encoded answer to a question on a vehicle's state key.

    Raises:
        SchemaError: no such key, no question.
        StoreError: the store has failed.
    """
    question, found = _found(store, key, payload)
    return ReportStates.fitting(
        found.get(report_id, ReportState(report_id, "unknown")) for report_id in question.report_ids
    ).encode()


def answer_of_known(store: Store, key: str, payload: bytes) -> bytes | None:
    """The same of those reports alone that the store holds; None: it holds none of them."""
    _, found = _found(store, key, payload)
    return ReportStates.fitting(found.values()).encode() if found else None


def _found(store: Store, key: str, payload: bytes) -> tuple[ReportQuestion, dict[str, ReportState]]:
    vehicle, question = parse_state_key(key), ReportQuestion.decode(payload)
    return question, {
        one.report_id: ReportState(
            one.report_id, STATUS[one.state], one.wanted if one.state == "wanted" else b"", one.reason
        )
        for one in store.upload_statuses(vehicle, question.report_ids)
    }
