"""Lists of the districts of whole layers: who answers for each, signing those for which nobody does, and again in time.

A publication adds a district that it begins (`sql_district_lists.add`). Here is what it leaves: the first list of a map
that has tiles already, districts that have moved here, a publisher that was revoked, and a later time.
"""

import time
from dataclasses import dataclass
from typing import Final

from gnd.fleet_bus.errors import NotAnsweredFor, SealError
from gnd.fleet_bus.publishers import Publishers
from gnd.schemas.district_list import DistrictList, district_of
from gnd.tile_store import sql_catalogs as catalogs
from gnd.tile_store import sql_district_lists as lists
from gnd.tile_store.catalogs import RENEWED_AFTER_S
from gnd.tile_store.connection import SqlConnection, fetch, post
from gnd.tile_store.errors import NotPublished
from gnd.tile_store.signatures import GOOD
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqlStore

ANOTHER: Final = "another writer was faster"


@dataclass(frozen=True, slots=True)
class AnsweredList:
    """Who answers for the list of a layer's districts.

    Attributes:
        layer: of the map.
        status: good; unsigned; wrong (it names others than are there); revoked, expired, foreign, unknown as
            `NotAnsweredFor` says.
        number: how often it was signed; 0: never.
        signed_s: when, POSIX seconds.
        districts: how many it names.
        who: role and name of who has signed it, where it is good.
        why: what is wrong.
    """

    layer: str
    status: str
    number: int = 0
    signed_s: int = 0
    districts: int = 0
    who: str = ""
    why: str = ""


def answered_list(store: SqlStore, publishers: Publishers, layer: str) -> AnsweredList:
    """Look at the list of a layer: the districts against those with tiles, and the signature."""
    return store.look(lambda c: _answered(c, publishers, layer))


def _answered(c: SqlConnection, publishers: Publishers, layer: str) -> AnsweredList:
    told = lists.list_of(c, layer)
    if told is None and not lists.numbers_there(c, layer):
        return AnsweredList(layer, GOOD)  # nothing is mapped, and nobody need say so
    if told is None:
        return AnsweredList(layer, "unsigned", why="nobody has signed it (`gnd map sign`)")
    signed = told.signature
    named, why, status, who = set(told.numbers or ()), "", GOOD, ""
    try:
        who = lists.who_signed_list(c, publishers, told)
    except NotAnsweredFor as error:
        status, why = error.why, str(error)
    except SealError as error:
        status, why = "unknown", str(error)
    there = lists.numbers_there(c, layer)
    if not why and (more := there - named):
        status, why = "wrong", f"{len(more)} districts with tiles are not in it ({lists.paths(more)})"
    elif not why and (gone := named - there - lists.numbers_moved(c)):
        status, why = "wrong", f"{len(gone)} districts that it names have no tiles ({lists.paths(gone)})"
    return AnsweredList(layer, status, signed.number, signed.signed_s, len(named), who if status == GOOD else "", why)


def due_lists(store: SqlStore, publishers: Publishers, before_s: float | None = None) -> list[str]:
    """The layers whose lists are to be signed: for which nobody answers, that do not name what is there, or that were
    signed before a time (POSIX seconds; None: `RENEWED_AFTER_S` ago, by the clock).
    """
    at_s = time.time() - RENEWED_AFTER_S if before_s is None else before_s

    def is_due(c: SqlConnection, layer: str) -> bool:
        told, there = lists.list_of(c, layer), _signed_there(c, layer)
        if told is None:
            return bool(there)
        is_other = told.head.region != lists.region_of(c) or not there <= set(told.numbers or ())
        return is_other or told.signature.signed_s < at_s or not lists.is_good(c, publishers, told)

    return store.look(lambda c: [layer for (layer,) in fetch(c, "layers") if is_due(c, layer)])


def _signed_there(c: SqlConnection, layer: str) -> set[int]:
    """The districts with tiles of which a catalog is signed: others are signed first."""
    return lists.numbers_there(c, layer) & {number for (number,) in fetch(c, "places_of_catalogs", {"layer": layer})}


def sign_list(store: SqlStore, layer: str, *, unchecked: bool = False) -> str:
    """Sign which districts a layer has, as it is now. What is not signed, and why; "": all is.

    What is signed already and still there is not looked at again. A district that comes new is left out while none of
    our publishers has signed its catalog, which clients refuse then anyway: so one shard that was revoked does not keep
    the others' districts waiting. Where one that was signed has gone without having moved, nothing is signed.

    Args:
        store: opened with an identity.
        layer: of the map.
        unchecked: also where districts have gone: somebody has looked at it.

    Raises:
        NotPublished: the store was opened without an identity.
    """
    signing = store.signing
    if signing is None:
        raise NotPublished(f"{store.location}: nobody to sign with: --identity FOLDER of an operator or a shard")

    def work(c: SqlConnection, _now: int) -> str:
        held = lists.number_of_list(c, layer)
        before, there = lists.list_of(c, layer), _signed_there(c, layer)
        if before is not None and not lists.is_good(c, signing.publishers, before):
            before = None  # its number and time are nobody's word
        named = set() if before is None else set(before.numbers or ())
        gone = named - lists.numbers_there(c, layer) - lists.numbers_moved(c)
        if gone and not unchecked:
            return f"{len(gone)} districts that were signed have gone ({lists.paths(gone)}); look, then --unchecked"
        left = {number: why for number in sorted(there - named) if (why := _not_signed(c, signing, layer, number))}
        numbers = sorted((named - gone) | there - left.keys())
        why = next(iter(left.values()), "")
        if not numbers and before is None:
            return why or "it has no districts with signed catalogs"
        is_same = before is not None and tuple(numbers) == before.numbers
        if left and is_same and before and before.signature.signed_s > time.time() - RENEWED_AFTER_S:
            return why
        return why if lists.put(c, signing, layer, numbers, before, held) else ANOTHER

    return store.transact(work)


def _not_signed(c: SqlConnection, signing: Signing, layer: str, number: int) -> str:
    """Why a district is not one to name; "": its catalog is signed."""
    state = catalogs.state_of(c, layer, district_of(number))
    try:
        if state is not None:
            catalogs.who_signed_catalog(c, signing.publishers, state)
            return ""
    except SealError as error:
        return f"the catalog of district {district_of(number)} does not count: {error}"
    return f"the catalog of district {district_of(number)} is not signed"


def mirror_list(store: SqlStore, publishers: Publishers, told: DistrictList, chain: bytes) -> bool:
    """Keep the list of districts of the map that is mirrored; False: nobody answers for it, or a newer one is here.

    Args:
        store: a mirror; it may hold a part of the districts.
        publishers: whose signatures count.
        told: the list.
        chain: the certificates behind its signature.
    """

    def work(c: SqlConnection, _now: int) -> bool:
        held = lists.number_of_list(c, told.head.layer)
        here, signed = lists.list_of(c, told.head.layer), told.signature
        if here == told:
            return True
        if here is not None and lists.is_good(c, publishers, here) and here.signature.order > signed.order:
            return False
        post(c, "put_publisher", {"signer": signed.signer, "chain": chain, "since_s": signed.signed_s})
        return told.numbers is not None and lists.is_good(c, publishers, told) and lists.keep(c, told, held)

    return store.transact(work)
