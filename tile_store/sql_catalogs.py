"""The signed state of each district's catalog in SQL: each function runs inside the caller's transaction.

Whoever changes which version of a tile is released does it inside `changing`: what was signed before is compared with
what is there, the digest of the tile's group is made anew, and the district is signed. A district with tiles for which
nobody answers stays so here: it is signed by `catalogs`, which looks at all of its versions.
"""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Final

from gnd.fleet_bus.errors import SealError
from gnd.fleet_bus.publishers import Publishers
from gnd.fleet_bus.seldom import Seldom
from gnd.gnd_map.tile_id import TILES_OF_DISTRICT, District, TileId
from gnd.schemas.catalog_signature import (
    GROUPS,
    NO_TILES,
    TILES_OF_GROUP,
    CatalogKind,
    CatalogSignature,
    CatalogStatement,
    digest_at,
    digest_of_rows,
    group_of,
    with_group,
)
from gnd.schemas.errors import BadValue
from gnd.schemas.tiles import Catalog, CatalogEntry
from gnd.tile_store import sql_district_lists as lists
from gnd.tile_store import sql_trials as trials
from gnd.tile_store.connection import Row, SqlConnection, change, fetch, post
from gnd.tile_store.errors import NotPublished
from gnd.tile_store.signing import Signing, who_answers
from gnd.tile_store.values import VersionKind

_SELDOM: Final = Seldom(logging.getLogger(__name__))
EMPTY: Final = NO_TILES * GROUPS
"""The digests of a district without tiles."""


@dataclass(frozen=True, slots=True)
class CatalogState:
    """What is signed of a district.

    Attributes:
        statement: which tiles there are, in which versions.
        signature: of who answers for that.
    """

    statement: CatalogStatement
    signature: CatalogSignature

    @property
    def name(self) -> str:
        """As messages call it."""
        return f"the catalog of district {self.statement.district} of layer {self.statement.layer}"


_Released = tuple[int, int, bytes]
"""Morton code of a tile, the newest released version, the hash of its content."""


def _released_between(c: SqlConnection, layer: str, first: int, end: int) -> list[_Released]:
    """What is released of the tiles from a Morton code to before another one, by tile."""
    rows = fetch(c, "heads", {"layer": layer, "first": first, "end": end})
    open_trials = trials.trials_between(c, layer, first, end) if rows else {}
    before = {tile.morton: (tile.morton, one.base_version, one.base_sha) for tile, one in open_trials.items()}
    return [before.get(tile) or (tile, version, bytes(sha)) for tile, version, sha in rows]


def released_of(c: SqlConnection, layer: str, district: District) -> list[CatalogEntry]:
    """The newest released versions of a district's tiles, by tile."""
    first = district.first_morton
    rows = _released_between(c, layer, first, first + TILES_OF_DISTRICT)
    return [CatalogEntry(TileId(tile), version, sha) for tile, version, sha in rows]


def catalog_of(c: SqlConnection, layer: str, district: District) -> Catalog:
    """The catalog of a district as clients get it, with its signature where there is one."""
    state = state_of(c, layer, district)
    signature = None if state is None else state.signature
    return Catalog(tuple(released_of(c, layer, district)), signature)


def state_of(c: SqlConnection, layer: str, district: District) -> CatalogState | None:
    """What is signed of a district; None: nothing."""
    first = district.first_morton
    rows = fetch(c, "catalog_state", {"layer": layer, "tile": first})
    return _state(layer, district, rows[0]) if rows else None


def _state(layer: str, district: District, row: Row) -> CatalogState | None:
    tiles, digests, number, signed_s, kind, signer, signature = row
    try:
        return CatalogState(
            CatalogStatement(layer, district, tiles, bytes(digests)),
            CatalogSignature(number, signed_s, kind, bytes(signer), bytes(signature)),
        )
    except BadValue:  # none that anybody can have made: as good as unsigned
        return None


def kind_of(kind: VersionKind) -> CatalogKind:
    """How a catalog comes about that names a version of a kind."""
    return "rollback" if kind == "rollback" else "published"


@contextmanager
def changing(
    c: SqlConnection, signing: Signing | None, layer: str, tile: TileId, kind: CatalogKind = "published"
) -> Iterator[None]:
    """What is done inside may change which version of a tile is released; afterwards the district is signed anew.

    Where somebody has changed the store behind its back, nothing is signed over that: publishing goes on, and clients
    refuse the catalog until an operator has looked (`gnd map sign --unchecked`).

    Raises:
        NotPublished: the district is signed, and this process has no identity, or one that has ended.
    """
    before = _before(c, signing, layer, tile.district)
    if before is None and (signing is None or _has_tiles(c, layer, tile.district)):
        yield
        return
    had = _group(c, layer, tile)
    if before is not None and not _is_there(before, tile, had):
        yield
        return
    yield
    has = _group(c, layer, tile)
    if has == had:
        return
    if signing is None:
        raise NotPublished(
            f"tile {tile.path} of layer {layer}: the catalogs of this store are signed; publish with the identity of a"
            " shard or an operator (--identity FOLDER)"
        )
    statement = CatalogStatement(layer, tile.district, 0, EMPTY) if before is None else before.statement
    after = replace(
        statement,
        tiles=statement.tiles + len(has) - len(had),
        digests=with_group(statement.digests, group_of(tile), digest_of_rows(has)),
    )
    put(c, signing, after, kind, before)
    if before is None:
        lists.add(c, signing, layer, tile.district)


def _is_there(before: CatalogState, tile: TileId, had: Sequence[_Released]) -> bool:
    """Whether a tile's group is as it was signed."""
    is_there = digest_at(before.statement.digests, group_of(tile)) == digest_of_rows(had)
    if not is_there:
        _SELDOM.warning(
            "%s names other versions beside tile %s than are there, and is not signed any more: the store was changed"
            " by hand, or by a program of an older release; see `gnd map verify --signatures`",
            before.name,
            tile.path,
        )
    return is_there


def _has_tiles(c: SqlConnection, layer: str, district: District) -> bool:
    first = district.first_morton
    return bool(fetch(c, "any_head", {"layer": layer, "first": first, "end": first + TILES_OF_DISTRICT}))


def _group(c: SqlConnection, layer: str, tile: TileId) -> list[_Released]:
    first = tile.morton - tile.morton % TILES_OF_GROUP
    return _released_between(c, layer, first, first + TILES_OF_GROUP)


def _before(c: SqlConnection, signing: Signing | None, layer: str, district: District) -> CatalogState | None:
    """The state that is built upon. One for which nobody answers any more is forgotten: all is looked at anew then."""
    state = state_of(c, layer, district)
    if state is None or signing is None:
        return state
    try:
        who_signed_catalog(c, signing.publishers, state)
    except SealError as error:
        _SELDOM.warning("%s is not built upon: %s", state.name, error)
        forget(c, layer, district)
        return None
    return state


def who_signed_catalog(c: SqlConnection, publishers: Publishers, state: CatalogState) -> str:
    """Role and name of the publisher that answers for a state.

    Raises:
        SealError: nobody does who may; why.
    """
    return who_answers(c, publishers, state.signature, state.signature.text(state.statement))


def put(
    c: SqlConnection, signing: Signing, statement: CatalogStatement, kind: CatalogKind, before: CatalogState | None
) -> None:
    """Sign a district, and keep it in the place of what was signed before.

    Raises:
        NotPublished: the certificate of this process has ended.
    """
    signature, chain = signing.sign_catalog(statement, kind, None if before is None else before.signature)
    post(c, "put_publisher", {"signer": signature.signer, "chain": chain, "since_s": signature.signed_s})
    keep(c, CatalogState(statement, signature))


def keep(c: SqlConnection, state: CatalogState) -> None:
    """Keep a state that somebody has signed."""
    said, signed = state.statement, state.signature
    row = {"layer": said.layer, "tile": said.district.first_morton, "tiles": said.tiles, "digests": said.digests}
    row |= {"number": signed.number, "signed_s": signed.signed_s, "kind": signed.kind}
    change(c, "put_catalog_state", row | {"signer": signed.signer, "signature": signed.signature})


def forget(c: SqlConnection, layer: str, district: District) -> None:
    """Nobody answers for a district any more."""
    post(c, "forget_catalog_state", {"layer": layer, "tile": district.first_morton})
