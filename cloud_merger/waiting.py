"""Gaussians that were asked of vehicles just now: not asked of the next one as well. In memory only, within bounds.

Nothing is lost with them: what is wanted of each report is in the store. Who has forgotten a promise asks one vehicle
more than it had to.
"""

import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from threading import Lock
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import I32
from gnd.gnd_map.tile_id import TileId

MOST_REPORTS: Final = 1024
"""Promises of at most so many reports; the oldest are forgotten first."""
KEEP_S: Final = 120.0
"""For so long a Gaussian that was asked for counts as promised."""
_NS_PER_S: Final = 1_000_000_000


class Promises:
    """The voxels of which Gaussians were asked, by report; safe in several threads.

    Args:
        now_ns: the clock, int ns.
    """

    def __init__(self, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._now_ns = now_ns
        self._lock = Lock()
        self._asked: OrderedDict[str, tuple[int, str, Mapping[TileId, I32]]] = OrderedDict()  # oldest first

    def __len__(self) -> int:
        with self._lock:
            return len(self._asked)

    def note(self, report_id: str, layer: str, asked: Mapping[TileId, I32]) -> None:
        """Gaussians of these voxels were asked for; the oldest promises make room."""
        with self._lock:
            self._asked.pop(report_id, None)
            self._asked[report_id] = (self._now_ns(), layer, asked)
            self._make_room()

    def forget(self, report_id: str) -> None:
        """They have come, or will not."""
        with self._lock:
            self._asked.pop(report_id, None)

    def of(self, tile: TileId, layer: str, *, but: str) -> I32:
        """(K,) voxels of a tile that other reports than `but` were asked about; a voxel may occur again."""
        with self._lock:
            self._make_room()
            others = [(where, asked) for report_id, (_, where, asked) in self._asked.items() if report_id != but]
        parts = [asked[tile] for where, asked in others if where == layer and tile in asked]
        return np.concatenate([np.zeros(0, np.int32), *parts])

    def _make_room(self) -> None:
        before_ns = self._now_ns() - round(KEEP_S * _NS_PER_S)
        while self._asked:
            report_id, (since_ns, _, _) = next(iter(self._asked.items()))
            if since_ns >= before_ns and len(self._asked) <= MOST_REPORTS:
                return
            del self._asked[report_id]
