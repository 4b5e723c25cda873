"""Measurements of a vehicle that drives now: in the order of their stamps, bounded, their clocks checked.

Callbacks of the bus put messages in from their own threads; the agent's thread takes measurements out. Where it cannot
keep up, the oldest scans are left out and counted: the newest counts.
"""

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, NamedTuple

from gnd.schemas.drive import DriveItem
from gnd.schemas.errors import BadValue
from gnd.schemas.limits import MAX_AHEAD_NS
from gnd.vehicle_agent.errors import ImportDriveError, VehicleError
from gnd.vehicle_agent.importers.ros.small_messages import STAMPED_NS
from gnd.vehicle_agent.sources.ros2_messages import BadRosMessage
from gnd.vehicle_agent.sources.stamp_order import StampOrder

ROUTER_WAIT_S: Final = 30.0
"""A vehicle and its sensors start together: so long their router is waited for."""
SCANS: Final = "scans"
"""The stream of which the oldest are left out."""
MOST_SCANS: Final = 20
"""So many scans wait for a vehicle that is busy: two seconds, in which its first tiles come, or many are decided."""
MOST_OTHERS: Final = 20_000
OFFSET_S: Final = 2.0
"""A clock that is farther from this machine's is worth a warning."""
APART_S: Final = 0.5
"""Clocks of two sensors that are farther apart."""
BACK_NS: Final = 1_000_000_000
"""Time that goes back by more: a recording began anew, or a clock was set."""
SILENT_S: Final = 5.0
_LOOK_S: Final = 0.02

_log = logging.getLogger(__name__)


class LiveError(VehicleError):
    """Live measurements by which no vehicle can drive; the message says which, and what to do."""


class _Waiting(NamedTuple):
    stream: str
    t_ns: int
    read: Callable[[], DriveItem | None]


class LiveItems:
    """The measurements that come in, from any number of threads; `drive` gives them to one.

    Args:
        streams: names of the streams, `SCANS` among them; of equal stamps the first stream's comes first.

    Attributes:
        received: messages by stream.
        left_out: by stream, for which there was no time: scans, and others only where very many wait.
        unreadable: messages by stream that were not what their type says.
    """

    def __init__(self, streams: Sequence[str]) -> None:
        self.received: Counter[str] = Counter()
        self.left_out: Counter[str] = Counter()
        self.unreadable: Counter[str] = Counter()
        self._order: StampOrder[_Waiting] = StampOrder(streams)
        self._ripe: deque[_Waiting] = deque()
        self._changed = threading.Condition()
        self._newest_ns: dict[str, int] = {}
        self._offset_ns: dict[str, int] = {}
        self._problem: LiveError | None = None
        self._warned: set[str] = set()

    def put(self, stream: str, t_ns: int, read: Callable[[], DriveItem | None]) -> None:
        """Take a message.

        Args:
            stream: its stream.
            t_ns: its stamp, ns UTC.
            read: makes the measurement of it, in the thread that drives; None: there is none in it.
        """
        now_s = time.monotonic()
        with self._changed:
            self.received[stream] += 1
            self._check_time(stream, t_ns)
            self._order.put(stream, t_ns, _Waiting(stream, t_ns, read), now_s)
            self._ripen(now_s)
            self._changed.notify()

    def refuse(self, stream: str, error: Exception) -> None:
        """Count a message that cannot be read, and say so once for each stream."""
        self.unreadable[stream] += 1
        self._warn(f"unreadable {stream}", f"{stream}: left out: {error}")

    def drive(self, stop: threading.Event, silent_s: float = 0.0) -> Iterator[DriveItem]:
        """Measurements in the order of their stamps, until `stop`.

        Args:
            stop: ends it.
            silent_s: it also ends once nothing has come for so long; 0: never.

        Raises:
            LiveError: time went back, stamps lie in the future, or before 1973.
        """
        heard_s = time.monotonic()
        while not stop.is_set():
            with self._changed:
                if self._problem is not None:
                    raise self._problem
                self._ripen(time.monotonic())
                if not self._ripe:
                    self._changed.wait(_LOOK_S)
                    self._say_silence(time.monotonic() - heard_s)
                    if silent_s and time.monotonic() - heard_s >= silent_s and not len(self._order):
                        return
                    continue
                waiting = self._ripe.popleft()
            heard_s = time.monotonic()
            item = self._read(waiting)
            if item is not None:
                yield item

    def account(self) -> dict[str, Any]:
        """What came, as plain values."""
        with self._changed:
            return {
                "received": dict(self.received),
                "scans_left_out": self.left_out[SCANS],
                "others_left_out": self.left_out.total() - self.left_out[SCANS],
                "late": {stream: n for stream, n in self._order.late.items() if n},
                "unreadable": dict(self.unreadable),
                "clock_offset_s": {stream: round(offset * 1e-9, 3) for stream, offset in self._offset_ns.items()},
            }

    def _ripen(self, now_s: float) -> None:
        self._ripe.extend(self._order.take(now_s))
        scans = sum(waiting.stream == SCANS for waiting in self._ripe)
        if scans > MOST_SCANS or len(self._ripe) > MOST_OTHERS:
            oldest = next(w for w in self._ripe if w.stream == SCANS or scans <= MOST_SCANS)
            self._ripe.remove(oldest)
            self.left_out[oldest.stream] += 1

    def _read(self, waiting: _Waiting) -> DriveItem | None:
        try:
            return waiting.read()
        except (BadRosMessage, ImportDriveError, BadValue) as error:
            self.refuse(waiting.stream, error)
            return None

    def _check_time(self, stream: str, t_ns: int) -> None:
        if t_ns < STAMPED_NS:
            self._problem = LiveError(f"{stream}: stamped {t_ns * 1e-9:.3f} s after 1970: nobody has set its clock")
        newest_ns = self._newest_ns.get(stream, t_ns)
        if t_ns < newest_ns - BACK_NS:
            self._problem = LiveError(
                f"{stream}: time went back by {(newest_ns - t_ns) * 1e-9:.1f} s: a recording began anew, or a clock was"
                " set. What was driven is reported; start the agent again"
            )
        self._newest_ns[stream] = max(newest_ns, t_ns)
        offset_ns = t_ns - time.time_ns()
        self._offset_ns[stream] = max(offset_ns, self._offset_ns.get(stream, offset_ns))  # of the shortest delay
        if offset_ns > MAX_AHEAD_NS:
            self._problem = LiveError(
                f"{stream}: stamps are {offset_ns * 1e-9:.0f} s ahead of this machine's clock: set one of the two; the"
                f" cloud takes no report from more than {MAX_AHEAD_NS * 1e-9:.0f} s ahead"
            )
        if abs(offset_ns) > OFFSET_S * 1e9:
            side = "ahead of" if offset_ns > 0 else "behind"
            self._warn(
                f"offset {stream}",
                f"{stream}: stamps are {abs(offset_ns) * 1e-9:.1f} s {side} this machine's clock: right only where a"
                " recording is played",
            )
        apart_s = (max(self._offset_ns.values()) - min(self._offset_ns.values())) * 1e-9
        if apart_s > APART_S and min(self.received[name] for name in self._offset_ns) > 1:
            offsets = ", ".join(f"{name} {offset * 1e-9:+.2f} s" for name, offset in self._offset_ns.items())
            self._warn("apart", f"the sensors' clocks are {apart_s:.2f} s apart ({offsets}): set them to one time")

    def _say_silence(self, silent_s: float) -> None:
        if silent_s >= SILENT_S:
            self._warn("silence", f"no measurement for {silent_s:.0f} s; so far {dict(self.received) or 'none at all'}")

    def _warn(self, about: str, text: str) -> None:
        if about not in self._warned:
            self._warned.add(about)
            _log.warning("%s", text)
