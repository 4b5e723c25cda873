"""The leases of a shard, kept alive by a thread of their own while their tiles wait and are merged."""

import logging
import threading
import time
from collections.abc import Callable, Iterable
from types import TracebackType
from typing import Final

from gnd.tile_store.errors import StoreError
from gnd.tile_store.store import Store
from gnd.tile_store.values import SHARD_SILENT_S, Claim

LONGEST_WORK_S: Final = 300.0
"""A claim is renewed for so long: a merge that hangs must not keep its tile for ever."""
BEATS_A_LEASE: Final = 4
LONGEST_PAUSE_S: Final = SHARD_SILENT_S / 3
_LOG = logging.getLogger(__name__)


class Leases:
    """Renews what `hold` was told of until `drop`, and gives the shard's sign of life.

    Args:
        store: that holds the leases.
        owner: the shard's name.
        lease_s: length of a lease; it is renewed at least four times in that time.
        steady_s: a clock that does not step.
    """

    def __init__(
        self, store: Store, owner: str, lease_s: float, steady_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._store, self._owner, self._lease_s, self._steady_s = store, owner, lease_s, steady_s
        self._lock = threading.Lock()
        self._held: dict[Claim, float] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="leases", daemon=True)

    def __enter__(self) -> "Leases":
        self._store.join(self._owner)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
        try:
            self._store.leave(self._owner)
        except StoreError as failure:
            _LOG.error("%s: leases are not freed, they run out: %s", self._owner, failure)

    def hold(self, claims: Iterable[Claim]) -> None:
        """Renew these from now on."""
        with self._lock:
            self._held |= dict.fromkeys(claims, self._steady_s())

    def drop(self, claim: Claim) -> None:
        """Renew this one no longer."""
        with self._lock:
            self._held.pop(claim, None)

    def renew(self) -> None:
        """Renew now; leases that others have taken, and those of endless merges, are dropped."""
        oldest_s = self._steady_s() - LONGEST_WORK_S
        with self._lock:
            self._held = {claim: since_s for claim, since_s in self._held.items() if since_s > oldest_s}
            claims = list(self._held)
        for claim, is_held in zip(claims, self._store.beat(self._owner, claims, self._lease_s), strict=True):
            if not is_held:
                self.drop(claim)

    def _run(self) -> None:
        while not self._stop.wait(min(self._lease_s / BEATS_A_LEASE, LONGEST_PAUSE_S)):
            try:
                self.renew()
            except StoreError as error:  # the next time may succeed before they run out
                _LOG.warning("%s: leases are not renewed: %s", self._owner, error)
