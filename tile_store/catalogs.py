"""Catalogs of whole districts: who answers for each, signing those for which nobody does, and signing again in time.

A signature tells a client which versions there are, and when that was so. Publishing keeps it up to date
(`sql_catalogs.changing`); here is what it needs beside: the first signature of a district that has tiles already, one
after a publisher was revoked, and a later time where nothing has changed.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from typing import Final

from gnd.fleet_bus.errors import NotAnsweredFor, SealError
from gnd.fleet_bus.publishers import Publishers
from gnd.gnd_map.tile_id import TILES_OF_DISTRICT, District, TileId
from gnd.schemas.catalog_signature import CatalogStatement
from gnd.schemas.tiles import CatalogEntry
from gnd.tile_store import sql_catalogs as catalogs
from gnd.tile_store import sql_versions as versions
from gnd.tile_store.connection import SqlConnection, fetch
from gnd.tile_store.errors import NotPublished
from gnd.tile_store.signatures import GOOD
from gnd.tile_store.signing import Signing, chain_of, who_signed
from gnd.tile_store.sqlite_store import SqlStore

RENEWED_AFTER_S: Final = 3600.0
"""A catalog that was signed so long ago is signed again, s: its age tells a client that nobody withholds newer ones."""
SIGNED_TOGETHER: Final = 64


@dataclass(frozen=True, slots=True)
class AnsweredCatalog:
    """Who answers for the catalog of a district.

    Attributes:
        layer: of the map.
        district: of the layer.
        status: good; unsigned; wrong (there are other versions than were signed, or the signature does not fit);
            revoked, expired, foreign, unknown as `NotAnsweredFor` says.
        number: how often it was signed; 0: never.
        signed_s: when, POSIX seconds.
        who: role and name of who has signed it, where it is good.
        why: what is wrong.
    """

    layer: str
    district: District
    status: str
    number: int = 0
    signed_s: int = 0
    who: str = ""
    why: str = ""


@dataclass(frozen=True, slots=True)
class DueCatalogs:
    """Districts of a layer to be signed: `whole` those for which nobody answers, `renewed` those signed long ago."""

    layer: str
    whole: tuple[District, ...]
    renewed: tuple[District, ...]


def answered_catalogs(
    store: SqlStore, publishers: Publishers, layer: str, region: str = ""
) -> Iterator[AnsweredCatalog]:
    """Look at the catalogs of all districts with tiles in a region: versions against digests, digests against
    signature. A region that is smaller than a district has none.
    """
    for district in districts_of(store, layer, region):
        if district.path.startswith(region.rstrip("/")):
            yield store.look(partial(_answered, publishers=publishers, layer=layer, district=district))


def districts_of(store: SqlStore, layer: str, region: str = "") -> list[District]:
    """The districts with tiles in a region, in order."""
    return [district for district, _ in groupby(store.heads(layer, region), key=lambda head: head.tile.district)]


def _answered(c: SqlConnection, publishers: Publishers, layer: str, district: District) -> AnsweredCatalog:
    state = catalogs.state_of(c, layer, district)
    if state is None:
        return AnsweredCatalog(layer, district, "unsigned", why="nobody has signed it (`gnd map sign`)")
    signed = state.signature
    told = AnsweredCatalog(layer, district, GOOD, signed.number, signed.signed_s)
    try:
        told = replace(told, who=catalogs.who_signed_catalog(c, publishers, state))
    except NotAnsweredFor as error:
        return replace(told, status=error.why, why=str(error))
    except SealError as error:
        return replace(told, status="unknown", why=str(error))
    there = catalogs.released_of(c, layer, district)
    if CatalogStatement.of(layer, district, there) == state.statement:
        return told
    why = f"{len(there)} tiles are there, not in the versions of the {state.statement.tiles} that {told.who} has signed"
    return replace(told, status="wrong", who="", why=why)


def due_catalogs(
    store: SqlStore, publishers: Publishers, is_mine: Callable[[District], bool], before_s: float | None = None
) -> list[DueCatalogs]:
    """What is to be signed of the districts of a shard, by layer.

    Args:
        store: of the map.
        publishers: whose signatures count.
        is_mine: whether a district is the shard's.
        before_s: what was signed before that time is signed again; None: `RENEWED_AFTER_S` ago, by the clock.
    """
    at_s = round(time.time() - RENEWED_AFTER_S if before_s is None else before_s)

    def due(c: SqlConnection, layer: str) -> DueCatalogs:
        signed = {number for (number,) in fetch(c, "places_of_catalogs", {"layer": layer})}
        missing = {number for (number,) in fetch(c, "districts", {"layer": layer})} - signed
        for (signer,) in fetch(c, "signers_of_catalogs", {"layer": layer}):
            if _is_revoked(c, publishers, bytes(signer)):
                named = {"layer": layer, "signer": bytes(signer)}
                missing |= {number for (number,) in fetch(c, "catalogs_of_signer", named)}
        old = fetch(c, "catalogs_signed_before", {"layer": layer, "before": at_s})
        again = (number for (number,) in old if number not in missing)
        return DueCatalogs(layer, _of_mine(sorted(missing), is_mine), _of_mine(again, is_mine))

    return store.look(lambda c: [due(c, layer) for (layer,) in fetch(c, "layers")])


def _of_mine(numbers: Iterable[int], is_mine: Callable[[District], bool]) -> tuple[District, ...]:
    return tuple(filter(is_mine, (TileId(number * TILES_OF_DISTRICT).district for number in numbers)))


def _is_revoked(c: SqlConnection, publishers: Publishers, signer: bytes) -> bool:
    if not publishers.knows(signer):
        try:
            publishers.learn(chain_of(c, signer) or b"")
        except SealError:
            return True  # of another authority: as good as unsigned
    return publishers.is_revoked(signer)


def renew_catalogs(store: SqlStore, layer: str, districts: Sequence[District]) -> list[District]:
    """Sign what is signed once more, with the time of now, all in one transaction; the districts for which somebody had
    answered.

    Only signatures are looked at, no versions: who reads the catalog compares those.

    Raises:
        NotPublished: the store was opened without an identity.
    """
    signing = _signing(store)

    def work(c: SqlConnection, _now: int) -> list[District]:
        done = list[District]()
        for district in districts:
            before = catalogs.state_of(c, layer, district)
            if before is not None and _is_good(c, signing, before):
                catalogs.put(c, signing, before.statement, "renewed", before)
                done.append(district)
        return done

    return store.transact(work) if districts else []


def sign_whole_catalog(store: SqlStore, layer: str, district: District, *, unchecked: bool = False) -> str:
    """Sign the catalog of a district as it is, where one of our publishers has signed each of its versions.

    Args:
        store: opened with an identity.
        layer: of the map.
        district: of the layer.
        unchecked: also where other versions were signed before, or one is no longer the newest: somebody has looked.

    Returns:
        Why it is not signed; "": it is.

    Raises:
        NotPublished: the store was opened without an identity.
    """
    signing = _signing(store)
    entries, why = store.look(lambda c: _looked_at(c, signing, layer, district, unchecked=unchecked))
    if why:
        return why

    def work(c: SqlConnection, _now: int) -> str:
        if catalogs.released_of(c, layer, district) != entries:
            return "a version was published meanwhile"
        before = catalogs.state_of(c, layer, district)
        if before is not None and not _is_good(c, signing, before):
            before = None  # its number and time are nobody's word
        catalogs.put(c, signing, CatalogStatement.of(layer, district, entries), "whole", before)
        return ""

    return store.transact(work)


def sign_unsigned_catalogs(store: SqlStore) -> dict[District, str]:
    """Sign the catalogs of all districts that nobody has signed; of those that are not to be signed why.

    Raises:
        NotPublished: the store was opened without an identity.
    """
    due = due_catalogs(store, _signing(store).publishers, lambda _district: True, before_s=0.0)
    told = [(district, sign_whole_catalog(store, one.layer, district)) for one in due for district in one.whole]
    return {district: why for district, why in told if why}


def _looked_at(
    c: SqlConnection, signing: Signing, layer: str, district: District, *, unchecked: bool
) -> tuple[list[CatalogEntry], str]:
    """The released versions of a district, and why they are not to be signed."""
    entries = catalogs.released_of(c, layer, district)
    if not entries:
        return entries, "it has no tiles"
    before = catalogs.state_of(c, layer, district)
    is_signed = before is not None and _is_good(c, signing, before)
    if not unchecked and is_signed and before and before.statement != CatalogStatement.of(layer, district, entries):
        return entries, "other versions were signed; look at it, then --unchecked"
    first = district.first_morton
    place = {"layer": layer, "first": first, "end": first + TILES_OF_DISTRICT}
    newest = {TileId(tile): version for tile, version in fetch(c, "newest_of_district", place)}
    heads = {TileId(tile): version for tile, version, _ in fetch(c, "heads", place)}
    for tile, version in newest.items():
        if not unchecked and heads.get(tile) != version:
            why = f"tile {tile.path} has a version {version}, which is not the newest; look at it, then --unchecked"
            return entries, why
    return entries, next(filter(None, (_not_signed(c, signing, layer, one) for one in entries)), "")


def _not_signed(c: SqlConnection, signing: Signing, layer: str, entry: CatalogEntry) -> str:
    """Why a version does not count; "": it does."""
    name = f"tile {entry.tile.path} version {entry.version}"
    stored = versions.stored(c, "stored_version", layer, entry.tile, version=entry.version)
    if stored is None or stored.sha != entry.sha:
        return f"{name} is not there"
    try:
        who_signed(c, signing.publishers, stored)
    except SealError as error:
        return f"{name}: {error}"
    return ""


def _is_good(c: SqlConnection, signing: Signing, state: catalogs.CatalogState) -> bool:
    try:
        catalogs.who_signed_catalog(c, signing.publishers, state)
    except SealError:
        return False
    return True


def _signing(store: SqlStore) -> Signing:
    if store.signing is None:
        raise NotPublished(f"{store.location}: nobody to sign with: --identity FOLDER of an operator or a shard")
    return store.signing
