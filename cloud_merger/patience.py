"""Word that a report is released waits for the ack of the vehicle's next one, where the vehicle has said that it may.

A word costs a packet, its acknowledgement and, with an identity, a record of TLS and a seal: five times what it says.
In an ack it costs what it says. Only "released" waits: of a report that is refused, or of which more is wanted, the
vehicle hears at once. What is kept here is in memory alone: a vehicle that hears nothing asks, and the store answers.
"""

import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from gnd.schemas.limits import MAX_STATES_OF_ACK
from gnd.schemas.report_states import ReportState

KEPT_S: Final = 90.0
"""So long a word waits. A vehicle reports what has changed every 40 s or 400 m; it asks after 120 s."""
MOST_PATIENT: Final = 65_536
"""Reports of which is remembered that their vehicles are patient."""
MOST_VEHICLES: Final = 16_384
"""Vehicles for which words wait; those of others are told at once."""


@dataclass(slots=True)
class _WaitingWords:
    since_s: float
    states: list[ReportState] = field(default_factory=list)


class PatientWords:
    """Words that wait, by vehicle. Safe in several threads; its memory is bounded.

    Args:
        clock_s: a clock that does not step, s.
    """

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s, self._lock = clock_s, threading.Lock()
        self._patient: OrderedDict[str, str] = OrderedDict()  # report id -> vehicle
        self._kept: OrderedDict[str, _WaitingWords] = OrderedDict()  # by vehicle, what waits longest first

    def expect(self, vehicle: str, report_id: str) -> None:
        """A report that has just come is patient."""
        with self._lock:
            self._patient[report_id] = vehicle
            if len(self._patient) > MOST_PATIENT:
                self._patient.popitem(last=False)

    def keep(self, vehicle: str, state: ReportState) -> bool:
        """Keep a word for later; False: it is to be told now, with those of `take`."""
        with self._lock:
            is_patient = self._patient.pop(state.report_id, None) == vehicle
            if not is_patient or state.status != "released":
                return False
            kept = self._kept.get(vehicle)
            if kept is None:
                if len(self._kept) >= MOST_VEHICLES:
                    return False
                kept = self._kept[vehicle] = _WaitingWords(self._clock_s())
            if len(kept.states) >= MAX_STATES_OF_ACK:
                return False
            kept.states.append(state)
            return True

    def take(self, vehicle: str) -> tuple[ReportState, ...]:
        """What waits for a vehicle; it is about to be told."""
        with self._lock:
            kept = self._kept.pop(vehicle, None)
            return () if kept is None else tuple(kept.states)

    def due(self) -> list[tuple[str, tuple[ReportState, ...]]]:
        """Whom to tell what now, because it has waited for `KEPT_S`."""
        found = []
        with self._lock:
            before_s = self._clock_s() - KEPT_S
            while self._kept and next(iter(self._kept.values())).since_s <= before_s:
                vehicle, kept = self._kept.popitem(last=False)
                found.append((vehicle, tuple(kept.states)))
        return found
