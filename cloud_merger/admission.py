"""Who may send how much: looked at before a report is kept, so that nothing is spent on what is beyond a limit.

Each vehicle has a bucket of reports and one of bytes, which fill at a steady rate; so has its owner, where certificates
tell owners. Without identity a name costs nothing: therefore new names are a bucket of their own, and begin with a part
of what a vehicle that is known may send at once. While vehicles that are known send reports, few names are let in at
their first message; the others are told when to come again, and who does so is let in then, which somebody who sends
each message under another name does not (greylisting, RFC 6647). What waits to be looked at is bounded for each vehicle
and in all, by the store, which all shards share. Who is beyond a limit is told how long to wait, and loses nothing.
While vehicles that are known send reports, those of newcomers wait a moment for a commit that the others cause anyway.
"""

import math
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

from gnd.fleet_bus.errors import Busy
from gnd.schemas.upload_head import UploadHead
from gnd.tile_store.uploads import FirstHalf

MIB: Final = 1024 * 1024
REPORTS_A_MINUTE: Final = 120.0
"""Of a vehicle, on the average; one that drives sends some ten."""
REPORTS_AT_ONCE: Final = 600
"""A vehicle that was out of reach may send so many at once, ..."""
NEWCOMER_REPORTS: Final = 120
"""... one that was never seen so many."""
BYTES_A_MINUTE: Final = 16.0 * MIB
BYTES_AT_ONCE: Final = 64.0 * MIB
OWNER_VEHICLES: Final = 1_000
"""An owner may send as much as so many vehicles."""
NAMES_A_MINUTE: Final = 1_200.0
NAMES_AT_ONCE: Final = 600
"""New names: after a restart every vehicle is new."""
FIRST_NAMES_A_MINUTE: Final = 60.0
"""New names at their first message, while a known vehicle has come within `FIRST_COME_S` and names cost nothing ..."""
FIRST_NAMES_AT_ONCE: Final = 20
FIRST_COME_S: Final = 60.0
AGAIN_A_MINUTE: Final = 240.0
"""... and those that come again after they were told to."""
AGAIN_AT_ONCE: Final = 120
REMEMBERED_NAMES: Final = 65_536
WAITING_OF_VEHICLE: Final = 256
"""Uploads of a vehicle that nobody has looked at."""
WAITING_OF_ALL: Final = 20_000
"""Of all vehicles; half of it is out of reach for names that are new."""
NONSENSE_A_MINUTE: Final = 120.0
NONSENSE_AT_ONCE: Final = 240
"""Messages without a readable head: they name nobody, so all of them share these."""
WAITING_RETRY_S: Final = 5.0
LONGEST_RETRY_S: Final = 60.0
LOOK_EVERY_S: Final = 0.5
KNOWN_AFTER_S: Final = 30.0
KNOWN_COME_S: Final = 10.0
"""Newcomers are patient while a known vehicle has come within so long."""
PATIENT_S: Final = 0.1
_MINUTE_S: Final = 60.0


class Waiting(Protocol):
    """What is asked of the store."""

    def uploads_waiting(self, vehicle: str | None, at_most: int) -> int:
        """See `Store.uploads_waiting`."""

    def first_halves(self, key: str, report_id: str) -> list[FirstHalf]:
        """See `Store.first_halves`."""


class TokenBucket:
    """So many at once, and so many a minute on the average. Not safe in several threads.

    Args:
        a_minute: at which it fills.
        at_once: what it holds.
        now_s: by a clock that does not step.
        filled: what it begins with; None: full.
    """

    __slots__ = ("_at_once", "_level", "_per_s", "_since_s")

    def __init__(self, a_minute: float, at_once: float, now_s: float, filled: float | None = None) -> None:
        self._per_s, self._at_once, self._since_s = a_minute / _MINUTE_S, at_once, now_s
        self._level = at_once if filled is None else filled

    def missing_s(self, amount: float, now_s: float) -> float:
        """How long until so much may be taken, s; 0: now. What is more than it holds may be taken when it is full."""
        self._level = min(self._at_once, self._level + (now_s - self._since_s) * self._per_s)
        self._since_s = now_s
        return max(0.0, (min(amount, self._at_once) - self._level) / self._per_s)

    def take(self, amount: float) -> None:
        """Take it; call `missing_s` before."""
        self._level -= amount


@dataclass(slots=True)
class _Account:
    """Of one name."""

    since_s: float
    reports: TokenBucket
    size: TokenBucket


class Admission:
    """Admits uploads or raises `Busy`. Safe in several threads; its memory is bounded whatever names are invented.

    Args:
        store: knows what waits, of all shards.
        reports_a_minute: of a vehicle.
        owner_of: the owner of a vehicle, where certificates tell it; "" where not.
        names_cost: whether certificates tell names; without them anybody may invent any number.
        clock_s: a clock that does not step, s.
    """

    def __init__(
        self,
        store: Waiting,
        reports_a_minute: float = REPORTS_A_MINUTE,
        owner_of: Callable[[str], str] = lambda _vehicle: "",
        names_cost: bool = False,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._store, self._rate, self._owner_of, self._clock_s = store, reports_a_minute, owner_of, clock_s
        self._lock = threading.Lock()
        self._accounts: OrderedDict[str, _Account] = OrderedDict()  # least lately used first
        self._owners: OrderedDict[str, _Account] = OrderedDict()
        self._names_cost = names_cost
        self._names = TokenBucket(NAMES_A_MINUTE, NAMES_AT_ONCE, clock_s())
        self._first_names = TokenBucket(FIRST_NAMES_A_MINUTE, FIRST_NAMES_AT_ONCE, clock_s())
        self._again = TokenBucket(AGAIN_A_MINUTE, AGAIN_AT_ONCE, clock_s())
        self._asked_s: OrderedDict[str, float] = OrderedDict()  # when a name came first that was not let in
        self._nonsense = TokenBucket(NONSENSE_A_MINUTE, NONSENSE_AT_ONCE, clock_s())
        self._waiting, self._looked_s = 0, clock_s() - LOOK_EVERY_S
        self._known_s = -math.inf

    def __len__(self) -> int:
        return len(self._accounts)

    def admit(self, key: str, head: UploadHead, size_bytes: int) -> float:
        """Take one upload out of its vehicle's buckets.

        Returns:
            How long it is to wait for a commit that others cause, s.

        Raises:
            Busy: with numbers, and how long to wait.
            StoreError: the store cannot be read.
        """
        vehicle = head.vehicle or self._vehicle_of(key, head.report_id)
        with self._lock:  # an invented name that is one too many costs no look into the store
            self._account(vehicle, self._clock_s())
        waiting = self._store.uploads_waiting(head.vehicle, WAITING_OF_VEHICLE) if head.vehicle else 0
        if waiting >= WAITING_OF_VEHICLE:
            raise Busy(
                f"{waiting} uploads of {vehicle} wait to be looked at, the limit is {WAITING_OF_VEHICLE}",
                WAITING_RETRY_S,
                "waiting",
            )
        in_all = self._in_all()
        with self._lock:
            now_s = self._clock_s()
            account = self._account(vehicle, now_s)
            is_known = now_s - account.since_s >= KNOWN_AFTER_S
            self._check_all(in_all, is_known)
            owner = self._owner_of(vehicle)
            for one in (account, *([self._owner(owner, now_s)] if owner else [])):
                _check(one, vehicle, size_bytes, now_s)
                one.reports.take(1)
                one.size.take(size_bytes)
            self._known_s = now_s if is_known else self._known_s
            return PATIENT_S if not is_known and now_s - self._known_s < KNOWN_COME_S else 0.0

    def admit_nonsense(self) -> None:
        """Take one message that cannot be read, and is to be kept in quarantine.

        Raises:
            Busy: there were too many of late.
        """
        with self._lock:
            missing_s = self._nonsense.missing_s(1, self._clock_s())
            if missing_s > 0:
                raise Busy(
                    f"more than {NONSENSE_A_MINUTE:g} messages a minute that cannot be read",
                    WAITING_RETRY_S,
                    "nonsense",
                )
            self._nonsense.take(1)

    def _vehicle_of(self, key: str, report_id: str) -> str:
        """Whose Gaussians these are: only their flags tell. "" where no flags have come."""
        return next((half.vehicle for half in self._store.first_halves(key, report_id)), "")

    def _in_all(self) -> int:
        """Uploads that wait, as it was at most half a second ago."""
        with self._lock:
            if self._clock_s() - self._looked_s < LOOK_EVERY_S:
                return self._waiting
            self._looked_s = self._clock_s()
        self._waiting = self._store.uploads_waiting(None, WAITING_OF_ALL)
        return self._waiting

    def _check_all(self, in_all: int, is_known: bool) -> None:
        limit = WAITING_OF_ALL if is_known else WAITING_OF_ALL // 2
        if in_all >= limit:
            raise Busy(
                f"{in_all} uploads wait to be looked at, the limit is {limit}", WAITING_RETRY_S, "waiting in all"
            )

    def _account(self, vehicle: str, now_s: float) -> _Account:
        account = self._accounts.get(vehicle)
        if account is not None:
            self._accounts.move_to_end(vehicle)
            return account
        names = self._names_of(vehicle, now_s)
        for one, a_minute in names:
            if one.missing_s(1, now_s) > 0:
                self._asked_s.setdefault(vehicle, now_s)
                _shortened(self._asked_s)
                raise Busy(f"more than {a_minute:g} new vehicles a minute", WAITING_RETRY_S, "names")
        for one, _ in names:
            one.take(1)
        self._asked_s.pop(vehicle, None)
        return _kept(self._accounts, vehicle, self._new(now_s, 1, NEWCOMER_REPORTS))

    def _names_of(self, vehicle: str, now_s: float) -> list[tuple[TokenBucket, float]]:
        """The buckets that a new name is taken out of, and how much a minute they give."""
        found = [(self._names, NAMES_A_MINUTE)]
        if self._names_cost or now_s - self._known_s >= FIRST_COME_S:
            return found
        if now_s - self._asked_s.get(vehicle, math.inf) >= WAITING_RETRY_S:
            return [*found, (self._again, AGAIN_A_MINUTE)]
        return [*found, (self._first_names, FIRST_NAMES_A_MINUTE)]

    def _owner(self, owner: str, now_s: float) -> _Account:
        if owner in self._owners:
            self._owners.move_to_end(owner)
            return self._owners[owner]
        return _kept(self._owners, owner, self._new(now_s, OWNER_VEHICLES, REPORTS_AT_ONCE))

    def _new(self, now_s: float, vehicles: int, filled: int) -> _Account:
        return _Account(
            now_s,
            TokenBucket(vehicles * self._rate, vehicles * REPORTS_AT_ONCE, now_s, vehicles * filled),
            TokenBucket(vehicles * BYTES_A_MINUTE, vehicles * BYTES_AT_ONCE, now_s),
        )


def _kept(accounts: "OrderedDict[str, _Account]", name: str, account: _Account) -> _Account:
    accounts[name] = account
    _shortened(accounts)
    return account


def _shortened(kept: "OrderedDict[str, _Account] | OrderedDict[str, float]") -> None:
    if len(kept) > REMEMBERED_NAMES:
        kept.popitem(last=False)


def _check(account: _Account, vehicle: str, size_bytes: int, now_s: float) -> None:
    missing_s = account.reports.missing_s(1, now_s)
    if missing_s > 0:
        raise Busy(f"{vehicle} has sent too many reports of late", _bounded(missing_s), "reports")
    missing_s = account.size.missing_s(size_bytes, now_s)
    if missing_s > 0:
        raise Busy(
            f"{vehicle} has sent too many bytes of late, these {size_bytes} are more", _bounded(missing_s), "bytes"
        )


def _bounded(missing_s: float) -> float:
    return min(max(missing_s, 0.1), LONGEST_RETRY_S)
