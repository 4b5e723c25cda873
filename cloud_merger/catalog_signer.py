"""Signs the catalogs of the districts that this shard owns, and the lists of its store's districts: those for which
nobody answers, and all again in time.
"""

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Final

from gnd.cloud_merger.expander_threads import working
from gnd.cloud_merger.ownership import Members
from gnd.fleet_bus.publishers import Publishers
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.tile_id import District
from gnd.tile_store.catalogs import (
    RENEWED_AFTER_S,
    SIGNED_TOGETHER,
    due_catalogs,
    renew_catalogs,
    sign_whole_catalog,
)
from gnd.tile_store.district_lists import due_lists, sign_list
from gnd.tile_store.errors import StoreClosed
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqlStore

SIGN_EVERY_S: Final = 5.0
FAILED_AGAIN_S: Final = 60.0
"""A district that is not to be signed is looked at again after so long: all its versions are."""
_LOG = logging.getLogger(__name__)


@contextmanager
def signing_catalogs(store: SqlStore, members: Members, signing: Signing | None) -> Iterator[None]:
    """Sign catalogs in a thread while the block runs; who has no identity signs nothing."""
    if signing is None:
        yield
        return
    signer = CatalogSigner(store, members, signing.publishers)
    with working(signer.work, threading.Event(), 1, SIGN_EVERY_S):
        yield


class CatalogSigner:
    """Looks now and then for districts whose catalogs are to be signed.

    Args:
        store: opened with an identity.
        members: whose district it is; that of a shard that has died falls to another.
        publishers: whose signatures count.
        renewed_after_s: a catalog that was signed so long ago is signed again, s.
    """

    def __init__(
        self, store: SqlStore, members: Members, publishers: Publishers, renewed_after_s: float = RENEWED_AFTER_S
    ) -> None:
        self._store, self._members, self._publishers = store, members, publishers
        self._renewed_after_s = renewed_after_s
        self._failed_s: dict[tuple[str, District], float] = {}
        self._failed_lists_s: dict[str, float] = {}

    def work(self) -> int:
        """Sign what is due, of each layer no more than some districts; how many were."""
        before_s, now_s, n = time.time() - self._renewed_after_s, time.monotonic(), 0
        self._failed_s = {place: at_s for place, at_s in self._failed_s.items() if at_s > now_s}
        for due in due_catalogs(self._store, self._publishers, self._members.is_mine, before_s):
            renewed = self._renewed(due.layer, self._left(due.layer, due.renewed))
            n += len(renewed) + self._whole(due.layer, self._left(due.layer, due.whole))
        return n + self._lists(before_s)

    def _lists(self, before_s: float) -> int:
        """Sign the lists of districts that are due; any shard may, and who comes second finds nothing to do."""
        n, again_s = 0, time.monotonic() + FAILED_AGAIN_S
        for layer in due_lists(self._store, self._publishers, before_s):
            if self._failed_lists_s.get(layer, 0.0) > time.monotonic():
                continue
            why = self._told(partial(sign_list, self._store, layer))
            n += not why
            if why:
                self._failed_lists_s[layer] = again_s
                _LOG.warning("the list of districts of layer %s is not signed: %s", layer, why)
        return n

    def _left(self, layer: str, districts: Sequence[District]) -> list[District]:
        """Some of these that did not fail a moment ago."""
        return [one for one in districts if (layer, one) not in self._failed_s][:SIGNED_TOGETHER]

    def _renewed(self, layer: str, districts: list[District]) -> list[District]:
        """Sign again; those for which nobody answers as a whole."""
        try:
            done = renew_catalogs(self._store, layer, districts)
        except StoreClosed:
            raise
        except GndError as error:  # a district that moves away, a certificate that has ended: the next look tells
            _LOG.warning("catalogs of layer %s are not signed again: %s", layer, error)
            return []
        self._whole(layer, [one for one in districts if one not in done])
        return done

    def _whole(self, layer: str, districts: list[District]) -> int:
        n, again_s = 0, time.monotonic() + FAILED_AGAIN_S
        for district in districts:
            why = self._told(partial(sign_whole_catalog, self._store, layer, district))
            n += not why
            if why:
                self._failed_s[layer, district] = again_s
                _LOG.warning("the catalog of district %s of layer %s is not signed: %s", district, layer, why)
        return n

    def _told(self, sign: Callable[[], str]) -> str:
        """Sign something; why it is not signed, "": it is."""
        try:
            return sign()
        except StoreClosed:
            raise
        except GndError as error:
            return str(error)
