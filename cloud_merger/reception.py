"""Where reports are received: a fallback for every district, and a `complete` queryable on those owned and active.

The router hands a report to a complete queryable alone. Of a district that has none (its first report, or its owner has
just died) every shard's fallback hears; there, only the shard that now owns the district answers, and from then on
declares it. So there is one ack in normal operation; while the views of who lives differ, none (the vehicle asks
again) or two (storing twice has no effect). Who asks again and again is answered by whoever hears it.

A district that moves to another store is busy for a moment: the store refuses it, and the vehicle is told to come back
soon. Then it is given up here, and the shards of the other store hear it.
"""

import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from hashlib import sha256
from typing import Final

from gnd.cloud_merger.ownership import ROLE, Members
from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.errors import Busy
from gnd.fleet_bus.seals import Holder
from gnd.fleet_bus.serving import Request, Serving
from gnd.gnd_map.tile_id import District
from gnd.schemas.changes import ChangeAck
from gnd.schemas.errors import SchemaError
from gnd.schemas.keys import alive_key, alive_keys, change_key, change_keys, parse_alive_key, parse_change_key
from gnd.schemas.upload_peek import peek_upload
from gnd.tile_store.errors import DistrictElsewhere, StoreError

MAX_DECLARED: Final = 4096
MAX_TOKENS: Final = 4096
"""Names of tokens that are remembered until the store knows them."""
REMEMBERED_REPORTS: Final = 65_536
"""Report ids whose vehicle is remembered."""
MOVING_RETRY_S: Final = 0.1
"""Who speaks of a district that is just moving is to come back after so long."""
ORPHAN_S: Final = 2.0
"""Who has asked for so long has no answer from the owner of the district."""
ORPHANED_S: Final = 30.0
"""Then all messages about the district are taken for so long."""
REMEMBERED_ORPHANS: Final = 4096
WORKERS: Final = 32  # threads of all of them: acks that come at the same time share a commit
_LOG = logging.getLogger(__name__)

Place = tuple[str, District]  # layer and district
Answer = Callable[[str, bytes, Holder | None], ChangeAck]


class Reception:
    """Declares this shard's queryables and its sign of life, and moves them when members come and go.

    Args:
        bus: open.
        members: kept up to date here.
        answer: takes (key, encoded message, who has sealed it) and gives the ack; called from several threads.
        on_death: called with the name of a member that has gone.
        is_shard: whether a name is that of a shard that works on this map, by what the store says: anybody may hold a
            token. `look_again` asks anew.
    """

    def __init__(
        self,
        bus: Bus,
        members: Members,
        answer: Answer,
        on_death: Callable[[str], object],
        is_shard: Callable[[str], bool] = lambda _name: True,
    ) -> None:
        self._bus, self._members, self._answer, self._on_death = bus, members, answer, on_death
        self._is_shard = is_shard
        self._tokens: set[str] = set()
        self._turns, self._orphans = UploadTurns(), Orphans()
        self._lock = threading.Lock()
        self._declared: dict[Place, Serving] = {}  # oldest first
        self._every: Serving | None = None

    def open(self) -> None:
        """Begin to receive; the sign of life comes last."""
        self._bus.watch_alive(alive_keys(ROLE), self._on_alive)
        self._every = self._bus.serve(
            change_keys(),
            self._fallback,
            workers=WORKERS,
            kind="change",
            turn_of=self._turns.of,
            concerns=self._may_answer,
        )
        self._bus.declare_alive(alive_key(ROLE, self._members.own))

    @property
    def districts(self) -> tuple[str, ...]:
        """Paths of the districts that this shard has declared, sorted."""
        with self._lock:
            return tuple(sorted({district.path for _, district in self._declared}))

    def _declare(self, place: Place) -> None:
        """Take a district from the fallback; the oldest goes back to it when there are too many."""
        with self._lock:
            if place in self._declared or not self._members.is_mine(place[1]):
                return
            serving = self._bus.serve(
                change_key(*place),
                self._own,
                complete=True,
                kind="change",
                beside=self._every,
                turn_of=self._turns.of,
            )
            self._declared[place] = serving
            if len(self._declared) > MAX_DECLARED:
                self._declared.pop(next(iter(self._declared))).close()

    def _give_up_foreign(self) -> None:
        with self._lock:
            for place in [place for place in self._declared if not self._members.is_mine(place[1])]:
                self._declared.pop(place).close()

    def _own(self, request: Request) -> bytes:
        return _encoded(self._answered(request), request)

    def _answered(self, request: Request) -> ChangeAck:
        try:
            ack = self._answer(request.key, request.payload, request.asker)
        except DistrictElsewhere as error:
            self._members.owners.looked_again()
            self._give_up_foreign()
            raise Busy(str(error), MOVING_RETRY_S, "moving") from None
        if ack.status != "quarantined":
            self._turns.note(request.payload)
        return ack

    def _may_answer(self, key: str, payload: bytes) -> bool:
        """Whether a question that has come to the fallback is one for it. Linked routers hand it to the fallbacks of
        other shards, too: what these said of its seal would make its vehicle forget the key that it shares with the
        owner.
        """
        place = _place(key)
        if place is None or self._members.owners().state(place[1]) == "leaving":
            return True  # nobody owns such a key; the answer says why it is refused
        if place in self._declared:
            return False
        if self._members.is_mine(place[1]):
            return True
        return self._members.owners().takes(place[1]) and self._orphans.has(place, key, payload)

    def _fallback(self, request: Request) -> bytes:
        place = _place(request.key)
        if place is None:
            return self._own(request)
        if self._members.owners().state(place[1]) == "leaving":
            raise Busy(f"district {place[1]} is just moving to another store", MOVING_RETRY_S, "moving")
        ack = self._answered(request)
        if ack.status != "quarantined":
            self._declare(place)
        return _encoded(ack, request)

    def look_again(self) -> None:
        """Believe the tokens of shards that the store has come to know meanwhile, of none that it forgot; and give up
        what districts that are new to the map have made another's.
        """
        for member in sorted(self._tokens):
            self._note(member, alive=self._is_shard(member))
        self._give_up_foreign()  # the map may have other districts now

    def _on_alive(self, key: str, alive: bool) -> None:
        try:
            member = parse_alive_key(key)[1]
        except SchemaError:
            return
        if not alive:
            self._tokens.discard(member)
        elif len(self._tokens) < MAX_TOKENS:
            self._tokens.add(member)
        self._note(member, alive=alive and self._is_shard(member))

    def _note(self, member: str, *, alive: bool) -> None:
        if not self._members.note(member, alive=alive):
            return
        _LOG.info("%s: %s has %s", self._members.own, member, "joined" if alive else "gone")
        if not alive:
            try:
                self._on_death(member)
            except StoreError as error:  # it has moved, or is away: leases end by themselves
                _LOG.warning("%s: what %s had begun stays its own for now: %s", self._members.own, member, error)
        self._give_up_foreign()


class Orphans:
    """Messages about districts of other shards that come again and again: a router hands them to this shard alone,
    whoever may own the district. Seen with linked routers in zenoh 1.10, which keep to a way that is none any more
    until somebody connects. Any shard may keep what any vehicle says, so it is kept here. Safe in several threads.
    """

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s, self._lock = clock_s, threading.Lock()
        self._heard_s: OrderedDict[bytes, float] = OrderedDict()
        self._until_s: dict[Place, float] = {}

    def has(self, place: Place, key: str, payload: bytes) -> bool:
        """Note that a message has come; whether nobody else answers, as far as can be told."""
        name, now_s = sha256(key.encode() + payload).digest()[:8], self._clock_s()
        with self._lock:
            if self._until_s.get(place, 0.0) > now_s:
                return True
            first_s = self._heard_s.setdefault(name, now_s)
            if len(self._heard_s) > REMEMBERED_ORPHANS:
                self._heard_s.popitem(last=False)
            if not ORPHAN_S <= now_s - first_s <= ORPHANED_S:
                if now_s - first_s > ORPHANED_S:  # of an earlier time
                    self._heard_s[name] = now_s
                return False
            self._until_s = {one: until_s for one, until_s in self._until_s.items() if until_s > now_s}
            self._until_s[place] = now_s + ORPHANED_S
        _LOG.warning("district %s is another shard's, which does not answer: reports are kept here", place[1])
        return True


class UploadTurns:
    """Whose turn an upload takes. Gaussians name a report only: it is that of the vehicle whose flags were taken under
    this id. Safe in several threads.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._vehicle_of: OrderedDict[bytes, str] = OrderedDict()

    def of(self, _key: str, payload: bytes) -> str:
        """The vehicle; "" where nobody knows."""
        vehicle, report_id = peek_upload(payload)
        if vehicle or not report_id:
            return vehicle
        with self._lock:
            return self._vehicle_of.get(report_id, "")

    def note(self, payload: bytes) -> None:
        """An upload was taken."""
        vehicle, report_id = peek_upload(payload)
        if vehicle and report_id:
            with self._lock:
                self._vehicle_of[report_id] = vehicle
                if len(self._vehicle_of) > REMEMBERED_REPORTS:
                    self._vehicle_of.popitem(last=False)


def _encoded(ack: ChangeAck, request: Request) -> bytes:
    return (ack.unnamed() if request.binds else ack).encode()


def _place(key: str) -> Place | None:
    try:
        return parse_change_key(key)
    except SchemaError:
        return None
