"""Packed reports whose Gaussians were asked for and have not come: in memory only, within bounds.

Nothing is lost with them. The vehicle keeps its report until it has an acknowledgement, and none was given: whoever has
forgotten a first half answers "resend".
"""

import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from threading import Lock
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cloud_merger.errors import MergerError
from gnd_map.arrays import I32
from gnd_map.tile_id import TileId
from schemas.changes import ChangeReport
from schemas.packed import PackedReport

_NS_PER_S: Final = 1_000_000_000


@dataclass(frozen=True, slots=True)
class WaitingLimits:
    """How much may wait.

    Attributes:
        reports: at most so many; the oldest are forgotten first.
        voxels: that they have observed together, some 4 bytes each.
        keep_s: for so long a Gaussian that was asked for counts as promised; a report that is older is forgotten.
        finished: ids of reports remembered as stored, so that a second half that comes twice is known.
    """

    reports: int = 1024
    voxels: int = 32_000_000
    keep_s: float = 120.0
    finished: int = 16_384

    def __post_init__(self) -> None:
        if min(self.reports, self.voxels, self.finished) < 1 or self.keep_s <= 0:
            raise MergerError(f"limits of waiting reports must be positive, got {self}")


@dataclass(frozen=True, slots=True, eq=False)
class Waiting:
    """A first half that was understood.

    Attributes:
        key: it came on.
        packed: as it came.
        report: expanded, its Gaussians withheld.
        mask: which of its new and modified voxels are wanted.
        encoded: the same as bytes of the ack.
        asked: of each tile the voxels that are wanted, sorted.
    """

    key: str
    packed: PackedReport
    report: ChangeReport
    mask: NDArray[np.bool_]
    encoded: bytes
    asked: Mapping[TileId, I32]

    @property
    def voxels(self) -> int:
        """What it weighs."""
        return sum(len(change.observed) + len(change.changed) for change in self.report.tiles)


class WaitingRoom:
    """First halves by report id; safe in several threads.

    Args:
        limits: what is kept at most.
        now_ns: the clock, int ns.
    """

    def __init__(self, limits: WaitingLimits, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._limits, self._now_ns = limits, now_ns
        self._lock = Lock()
        self._held: OrderedDict[str, tuple[int, int, Waiting]] = OrderedDict()  # since when, voxels; oldest first
        self._voxels = 0
        self._finished: OrderedDict[str, None] = OrderedDict()

    def __len__(self) -> int:
        with self._lock:
            return len(self._held)

    def hold(self, waiting: Waiting) -> None:
        """Keep a first half, in place of an earlier one of this report; the oldest make room."""
        with self._lock:
            self._drop(waiting.packed.report_id)
            self._held[waiting.packed.report_id] = (self._now_ns(), waiting.voxels, waiting)
            self._voxels += waiting.voxels
            self._make_room()

    def get(self, report_id: str) -> Waiting | None:
        """The first half of this report, if it is still here."""
        with self._lock:
            self._make_room()
            held = self._held.get(report_id)
        return None if held is None else held[2]

    def finish(self, report_id: str) -> None:
        """The report is durable: forget its first half, remember its id."""
        with self._lock:
            self._drop(report_id)
            self._finished[report_id] = None
            self._finished.move_to_end(report_id)
            while len(self._finished) > self._limits.finished:
                self._finished.popitem(last=False)

    def has_finished(self, report_id: str) -> bool:
        """Whether this shard knows that the report is durable; False says nothing."""
        with self._lock:
            return report_id in self._finished

    def forget(self, report_id: str) -> None:
        """The report is of no use: forget its first half."""
        with self._lock:
            self._drop(report_id)

    def promised(self, tile: TileId, layer: str, *, but: str) -> I32:
        """(K,) voxels of a tile that other vehicles' reports than `but` were asked about; a voxel may occur again."""
        with self._lock:
            self._make_room()
            others = [waiting for _, _, waiting in self._held.values() if waiting.packed.report_id != but]
        parts = [w.asked[tile] for w in others if w.report.layer == layer and tile in w.asked]
        return np.concatenate([np.zeros(0, np.int32), *parts])

    def _make_room(self) -> None:
        """Forget what is too old, and the oldest while there is too much; a single one may be as large as it likes."""
        before_ns = self._now_ns() - round(self._limits.keep_s * _NS_PER_S)
        while self._held:
            report_id, (since_ns, _, _) = next(iter(self._held.items()))
            crowded = len(self._held) > self._limits.reports or self._voxels > self._limits.voxels
            if since_ns >= before_ns and not (crowded and len(self._held) > 1):
                return
            self._drop(report_id)

    def _drop(self, report_id: str) -> None:
        held = self._held.pop(report_id, None)
        if held is not None:
            self._voxels -= held[1]
