"""A map that nobody has signed, as those see it who take signed versions only: said once a minute, with what to do."""

import logging
import threading
import time
from collections.abc import Callable
from typing import Final

from gnd.fleet_bus.refusals import counted

UNSIGNED_TOLD_EVERY_S: Final = 60.0
_LOG: Final = logging.getLogger(__name__)


class UnsignedTold:
    """Counts versions that came without a signature, and tells of them. Safe in several threads.

    As long as no signed version has come, the map is taken for one that nobody has signed: then a client waits for
    tiles until somebody does. Later, a missing signature is that of one version.

    Args:
        layer: name of the layer.
        clock_s: a clock that does not step, s.

    Attributes:
        times: how often the map was said to be unsigned.
    """

    def __init__(self, layer: str, clock_s: Callable[[], float] = time.monotonic) -> None:
        self.times = 0
        self._layer, self._clock_s = layer, clock_s
        self._lock, self._refused, self._is_signed, self._next_s = threading.Lock(), 0, False, clock_s()

    def signed(self) -> None:
        """A version came that somebody answers for."""
        with self._lock:
            self._is_signed = True

    def refused(self, name: str) -> None:
        """A version without a signature came, and is not taken."""
        counted("version", "unsigned")
        with self._lock:
            self._refused += 1
            if self._is_signed or self._clock_s() < self._next_s:
                return
            self._next_s = self._clock_s() + UNSIGNED_TOLD_EVERY_S
            self.times += 1
            told = self._refused
        _LOG.warning(
            "still without a map of layer %s: nobody has signed it, and this client has an identity, so it takes signed"
            " versions only (%d answers refused so far, the last %s). It goes on asking. Who runs the cloud signs the"
            " map once: gnd map sign STORE --identity FOLDER-OF-AN-OPERATOR",
            self._layer,
            told,
            name,
        )
