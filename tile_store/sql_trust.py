"""Whose word counts, in SQL: each function runs inside the caller's transaction."""

from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import replace
from hashlib import sha256
from threading import Lock
from typing import Any, Final

from gnd.gnd_map.features import is_feature_layer
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store import sql_journal as journal
from gnd.tile_store.connection import SqlConnection, change, fetch, post
from gnd.tile_store.sql_accounts import NEWEST_TESTS, ids_of
from gnd.tile_store.sql_inbox import merge_again
from gnd.tile_store.values import QUARANTINED, AgreementTest, Basis, VehicleTrust, counted_out

_COUNTS: Final = ("claims", "refuted_claims", "quotes", "refuted_quotes", "refuted", "seen")
REFUTED_SHOWN: Final = 4096
REMEMBERED_OWNERS: Final = 65_536
REFUTED_TILES: Final = 3
"""A vehicle does not count any more when others have contradicted it in so many tiles, ..."""
REFUTED_SHARE: Final = 0.5
"""... if they are so many of all in which they could, ..."""
REFUTED_STATEMENTS: Final = 0.4
"""... or if they have contradicted so many of all its statements: where two of three lie, no tile says it clearly; and
of its claims as much as ..."""
REFUTED_SEEN: Final = 0.1
"""... this share of what it has seen there, unless what it says is as it was is contradicted as often."""


def put_tests(
    c: SqlConnection,
    layer: str,
    tile: TileId,
    tests: Iterable[AgreementTest],
    timing: dict[str, Any],
    is_news: bool = True,
) -> None:
    """Enter the tests of a tile. Where that puts a vehicle into quarantine, or lets it out, all tiles that it has
    reported about are merged again.

    `is_news`: a report was merged for the first time. Nobody is let out without one: merging again without a vehicle
    is no new evidence, and could let it in and out for ever.
    """
    made, vehicles = list(tests), set()
    place = {"layer": layer, "tile": tile.morton}
    before = {row[0]: row[1:] for row in fetch(c, "agreement_tests_of_tile", place | ids_of(t.report_id for t in made))}
    for test in made:
        told = {name: getattr(test, name) for name in AgreementTest.__slots__ if name != "is_refuted"}
        told["refuted"] = int(test.is_refuted)
        now = tuple(told[name] for name in _COUNTS)
        if before.get(test.report_id) == now:
            continue  # a tile's tests come with each of its merges
        post(c, "put_agreement_test", told | place)
        vehicles.add(test.vehicle)
    known = {one.vehicle: one for one in quarantined(c)} if vehicles else {}
    for vehicle in sorted(vehicles):
        found = trust_of(c, vehicle)
        is_wrong = is_bad(found)
        if is_wrong and vehicle not in known:
            said, wrong = found.claims + found.quotes, found.refuted_claims + found.refuted_quotes
            why = f"others contradict it in {found.refuted} of {found.tested} tiles, {wrong} of {said} statements"
            told = {"vehicle": vehicle, "since_ns": timing["now"], "source": "agreement", "why": why}
            change(c, "quarantine_vehicle", told)
            _merge_its_tiles_again(c, vehicle, timing)
        elif vehicle in known and is_news and not is_wrong and _let_out(c, vehicle):
            _merge_its_tiles_again(c, vehicle, timing)


def is_bad(found: VehicleTrust) -> bool:
    """Whether a vehicle's word counts no more, by what its tests say."""
    if found.refuted < REFUTED_TILES:
        return False
    said, wrong = found.claims + found.quotes, found.refuted_claims + found.refuted_quotes
    is_much = found.refuted_claims >= REFUTED_SEEN * found.seen or found.refuted_quotes >= found.refuted_claims
    return found.refuted >= REFUTED_SHARE * found.tested or (is_much and wrong >= REFUTED_STATEMENTS * said)


def _let_out(c: SqlConnection, vehicle: str) -> bool:
    """Whom an operator has taken out stays out."""
    return change(c, "release_vehicle", {"vehicle": vehicle, "any": 0}) > 0


def is_outdated(c: SqlConnection, layer: str, basis: Basis | None) -> bool:
    """Whether somebody has come into quarantine or out of it since a merge was begun: it may mix both."""
    if basis is None or is_feature_layer(layer):
        return False
    return counted_out(basis.named) != {QUARANTINED + one.vehicle for one in quarantined(c)}


def quarantined(c: SqlConnection) -> list[VehicleTrust]:
    """The vehicles whose reports do not count."""
    return [
        VehicleTrust(vehicle, 0, 0, 0, 0, 0, 0, True, source, why, since_ns)
        for vehicle, since_ns, source, why in fetch(c, "quarantined_vehicles")
    ]


def trust_of(c: SqlConnection, vehicle: str) -> VehicleTrust:
    """What the newest tests of a vehicle say, tile by tile, and whether it is quarantined."""
    rows = fetch(c, "agreement_tests_of_vehicle", {"vehicle": vehicle, "n": NEWEST_TESTS})
    claims, wrong_claims, quotes, wrong_quotes = (sum(row[column] for row in rows) for column in range(1, 5))
    state = next((one for one in quarantined(c) if one.vehicle == vehicle), None)
    refuted, seen = sum(1 for row in rows if row[5]), sum(row[6] for row in rows)
    found = VehicleTrust(
        vehicle, len(rows), refuted, claims, wrong_claims, quotes, wrong_quotes, state is not None, seen=seen
    )
    return found if state is None else replace(found, by=state.by, why=state.why, since_ns=state.since_ns)


def trusts(c: SqlConnection) -> list[VehicleTrust]:
    """Of all vehicles that were judged or quarantined, by vehicle."""
    return [trust_of(c, vehicle) for (vehicle,) in fetch(c, "judged_vehicles")]


def refuted_tests(c: SqlConnection) -> list[tuple[str, TileId, str, str]]:
    """The newest reports that others contradict as a whole: layer, tile, report, vehicle."""
    rows = fetch(c, "refuted_tests", {"n": REFUTED_SHOWN})
    return [(layer, TileId(tile), report_id, vehicle) for layer, tile, report_id, vehicle in rows]


def quarantine(c: SqlConnection, vehicle: str, why: str, timing: dict[str, Any]) -> None:
    """An operator takes a vehicle out, until an operator lets it in again."""
    told = {"vehicle": vehicle, "since_ns": timing["now"], "source": "operator", "why": why}
    change(c, "quarantine_vehicle", told)
    _merge_its_tiles_again(c, vehicle, timing)


def release(c: SqlConnection, vehicle: str, timing: dict[str, Any]) -> bool:
    """An operator lets a vehicle in again: what was held against it until now is pardoned, its reports count again."""
    ((newest_test_ns,),) = fetch(c, "newest_agreement_test", {"vehicle": vehicle})
    ((newest_ns,),) = fetch(c, "newest_standing", {"vehicle": vehicle})
    is_free = change(c, "release_vehicle", {"vehicle": vehicle, "any": 1})
    if not is_free + change(c, "delete_lone_words", {"vehicle": vehicle}):
        return False
    change(c, "pardon_vehicle", {"vehicle": vehicle, "until_ns": max(newest_test_ns, newest_ns)})
    _merge_its_tiles_again(c, vehicle, timing)
    return True


def note_owner(c: SqlConnection, vehicle: str, owner: str, since_ns: int) -> None:
    """Whose a vehicle is from then on: a digest, for only whether two are the same matters."""
    change(c, "put_owner", {"vehicle": vehicle, "owner": digest_of_owner(owner), "since_ns": since_ns})


def digest_of_owner(owner: str) -> str:
    """What an owner is told from others by."""
    return sha256(b"gnd owner" + owner.encode()).hexdigest()[:16]


def owners_of(c: SqlConnection, vehicles: Iterable[str]) -> dict[str, tuple[tuple[int, str], ...]]:
    """Of some vehicles, since when whose they are."""
    found: dict[str, tuple[tuple[int, str], ...]] = {}
    for vehicle, since_ns, owner in fetch(c, "owners_of", ids_of(sorted(set(vehicles)))):
        found[vehicle] = (*found.get(vehicle, ()), (since_ns, owner))
    return found


class OwnersNoted:
    """Owners that were noted last, so that a report costs no write for what is known. Safe in several threads."""

    def __init__(self) -> None:
        self._lock, self._held = Lock(), OrderedDict[str, str]()

    def is_news(self, vehicle: str, owner: str) -> bool:
        """Whether it was not noted of late."""
        with self._lock:
            return self._held.get(vehicle) != owner

    def note(self, vehicle: str, owner: str) -> None:
        """It stands in the store."""
        with self._lock:
            self._held[vehicle] = owner
            if len(self._held) > REMEMBERED_OWNERS:
                self._held.popitem(last=False)


def _merge_its_tiles_again(c: SqlConnection, vehicle: str, timing: dict[str, Any]) -> None:
    """All tiles that it has spoken of since their epochs; windows that hold a report of it are folded anew."""
    for layer, morton, is_folded in fetch(c, "tiles_spoken_of", {"vehicle": vehicle}):
        if is_feature_layer(layer):
            continue  # features weigh their observers themselves
        tile = TileId(morton)
        if is_folded:
            head = fetch(c, "head", {"layer": layer, "tile": morton})
            journal.reopen(c, layer, tile, head[0][1] if head else 0)
        merge_again(c, layer, tile, timing)
