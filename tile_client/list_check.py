"""Which districts a layer of a map has, as its publishers have signed it: a district that is withheld is noticed.

Each store of a map has a list of its own, which goes on naming what has moved away. A client takes all that come, each
only where a publisher of the pinned authority has signed it and no newer one was seen.
"""

import logging
import threading
import time
from dataclasses import dataclass
from typing import Final

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.publishers import Publishers
from gnd.fleet_bus.refusals import counted
from gnd.fleet_bus.seldom import Seldom
from gnd.gnd_map.tile_id import TILES_OF_DISTRICT, District
from gnd.schemas.district_list import HEAD_ONLY, DistrictList, district_of
from gnd.schemas.errors import NotSigned
from gnd.schemas.keys import list_keys, parse_list_key
from gnd.tile_client.archive_check import SeenStates
from gnd.tile_client.signed_state import RefusedStateError, check_answered, check_order

LIST_KEPT_S: Final = 60.0
"""A list is asked for again after so long, and when a district comes that it does not name."""
_SELDOM: Final = Seldom(logging.getLogger(__name__))


@dataclass(frozen=True, slots=True)
class ListedDistricts:
    """The districts of a layer.

    Attributes:
        numbers: of all of them (Morton code / 1024).
        signed_s: when the oldest of the lists was signed, POSIX seconds; 0: there is none.
    """

    numbers: frozenset[int] = frozenset()
    signed_s: int = 0

    def __contains__(self, district: District) -> bool:
        """Whether a list names it."""
        return district.first_morton // TILES_OF_DISTRICT in self.numbers

    def below(self, prefix: str) -> list[District]:
        """Those of a region, the leading chunks of a tile's path: each that it lies in, or that lies in it."""
        found = map(district_of, sorted(self.numbers))
        return [one for one in found if one.path.startswith(prefix) or prefix.startswith(one.path)]


class ListCheck:
    """Asks for the lists of one layer, and checks them. Safe in several threads.

    Args:
        publishers: whose signature counts.
        layer: name of the layer.
        seen: which states of lists were seen before.
        oldest_s: a list that was signed longer ago is refused, s; None: any age will do.
    """

    def __init__(self, publishers: Publishers, layer: str, seen: SeenStates, oldest_s: float | None = None) -> None:
        self._publishers, self._layer, self._seen, self._oldest_s = publishers, layer, seen, oldest_s
        self._lock, self._known, self._until_s = threading.Lock(), ListedDistricts(), float("-inf")

    def ask(self, bus: Bus, timeout_s: float, *, again: bool = False) -> ListedDistricts:
        """The districts of the layer; those of a moment ago, unless they are asked for again.

        Raises:
            RequestFailed: nobody answers within `timeout_s`.
            NotSigned: of the lists that came none is to be used; or none came, and one was seen before, or one that
                is not older than so long is wanted.
            SchemaError: an answer that is none.
        """
        with self._lock:
            if not again and time.monotonic() < self._until_s:
                return self._known
        replies = bus.request_many(list_keys(self._layer), b"", kind="catalog", timeout_s=timeout_s)
        known = self.check([(key, DistrictList.decode(payload)) for key, payload in replies])
        with self._lock:
            self._known, self._until_s = known, time.monotonic() + LIST_KEPT_S
        return known

    def ask_head(self, bus: Bus, timeout_s: float) -> int:
        """When the oldest of the layer's lists was signed, POSIX seconds; the districts are not sent.

        Raises:
            RequestFailed, NotSigned, SchemaError: as `ask`; NotSigned also where there is no list.
        """
        replies = bus.request_many(list_keys(self._layer), HEAD_ONLY, kind="catalog", timeout_s=timeout_s)
        told = [(key, DistrictList.decode(payload)) for key, payload in replies]
        signed_s = self.check(told, heads=True).signed_s
        if not signed_s:
            raise NotSigned(f"list of districts of layer {self._layer}: nobody has signed one")
        return signed_s

    def check(self, replies: list[tuple[str, DistrictList]], *, heads: bool = False) -> ListedDistricts:
        """What lists say that came under their keys; see `ask`. `heads`: they may come without their districts."""
        good, refused = list[DistrictList](), list[str]()
        for key, told in replies:
            try:
                self._check(key, told, heads=heads)
                good.append(told)
            except RefusedStateError as error:
                counted("catalog", f"list {error.reason}")
                refused.append(f"list of districts of layer {self._layer}: {error}")
                _SELDOM.warning("%s", refused[-1])
        missing = self._seen.names(f"{self._layer}@") - {self._name(one) for one in good}
        if missing:
            counted("catalog", "list withheld", len(missing))
            _SELDOM.warning("%s", self._withheld(missing))
        if not good and (refused or missing):
            raise NotSigned(refused[0] if refused else self._withheld(missing))
        if not good and not heads:
            self._none_came()
        numbers = frozenset(number for one in good for number in one.numbers or ())
        return ListedDistricts(numbers, min((one.signature.signed_s for one in good), default=0))

    def _none_came(self) -> None:
        """A layer without tiles has no list, and one that is withheld shows none: tell it, or refuse what nobody signed
        where a state of some age is wanted.
        """
        counted("catalog", "no list")
        told = (
            f"list of districts of layer {self._layer}: none came: the map has nothing of this layer, or all of it is"
            " withheld; nobody has signed which"
        )
        if self._oldest_s is not None:
            raise NotSigned(f"{told}, and one of the last {self._oldest_s / 3600:.1f} h is wanted")
        _SELDOM.warning("%s", told)

    def _withheld(self, missing: set[str]) -> str:
        regions = ", ".join(sorted(name.partition("@")[2] for name in missing)[:3])
        return (
            f"list of districts of layer {self._layer}: that of region {regions} was seen before and did not come: it"
            " is withheld, or its tile server is away, or its store has another name now"
        )

    def _check(self, key: str, told: DistrictList, *, heads: bool) -> None:
        layer, region = parse_list_key(key)
        if (layer, region) != (told.head.layer, told.head.region) or layer != self._layer:
            raise RefusedStateError("wrong", f"is that of layer {told.head.layer}, region {told.head.region}")
        if told.numbers is None and not heads:
            raise RefusedStateError("wrong", f"came without its {told.head.count} districts")
        signed, newest = told.signature, self._seen.newest(self._name(told))
        check_answered(self._publishers, signed, told.text, f"{told.head.count} districts")
        check_order(signed, newest, self._oldest_s, f" of region {region}")
        self._seen.note(self._name(told), signed.order)

    @staticmethod
    def _name(told: DistrictList) -> str:
        return f"{told.head.layer}@{told.head.region}"
