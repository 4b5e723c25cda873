"""Who answers for the versions of a store, one after the other; and signing those for which nobody does."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

from gnd.fleet_bus.errors import NotAnsweredFor, SealError
from gnd.fleet_bus.publishers import Publishers
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import SchemaError
from gnd.tile_store import sql_versions as versions
from gnd.tile_store.connection import SqlConnection
from gnd.tile_store.errors import NotPublished
from gnd.tile_store.signing import sign_again, who_signed
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.values import StoredTile, VersionKind

GOOD: Final = "good"
NEVER_SIGNED: Final = frozenset({"wrong", "damaged"})
"""What somebody has changed after it was signed: it is not signed again, but rolled back or imported anew."""
SIGNED_TOGETHER: Final = 256


@dataclass(frozen=True, slots=True)
class AnsweredVersion:
    """Who answers for one version.

    Attributes:
        layer: of the map.
        tile: of the layer.
        version: its number.
        kind: base, merged or rollback.
        status: good; unsigned, wrong, revoked, expired, foreign, unknown as `NotAnsweredFor` says; damaged (its body is
            not what its hash says).
        who: role and name of who has signed it, where it is good.
        why: what is wrong.
    """

    layer: str
    tile: TileId
    version: int
    kind: VersionKind
    status: str
    who: str = ""
    why: str = ""


def signatures(
    store: SqlStore, publishers: Publishers, layer: str, region: str = "", *, all_versions: bool = False
) -> Iterator[AnsweredVersion]:
    """Look at the versions of a region's tiles, the newest or all: content against hash, hash against signature."""
    for head in store.heads(layer, region):
        lines = store.history(layer, head.tile) if all_versions else ()
        for version in [line.version for line in lines] or [head.version]:
            stored = store.get(layer, head.tile, version)
            if stored is not None:
                yield _answered(store, publishers, stored)


def _answered(store: SqlStore, publishers: Publishers, stored: StoredTile) -> AnsweredVersion:
    told = AnsweredVersion(stored.layer, stored.tile, stored.version, stored.kind, GOOD)
    try:
        stored.decode()
        return replace(told, who=store.look(lambda c: who_signed(c, publishers, stored)))
    except NotAnsweredFor as error:
        return replace(told, status=error.why, why=str(error))
    except SealError as error:  # certificates that cannot be read
        return replace(told, status="unknown", why=str(error))
    except SchemaError as error:
        return replace(told, status="damaged", why=str(error))


def sign_versions(store: SqlStore, found: Sequence[AnsweredVersion]) -> int:
    """Put the signature of this process under versions, a few in each transaction; how many.

    Raises:
        NotPublished: the store was opened without an identity.
        StoreDamaged: a version has changed since it was looked at.
    """
    if store.signing is None:
        raise NotPublished(f"{store.location}: nobody to sign with: --identity FOLDER of an operator or a shard")

    def work(some: Sequence[AnsweredVersion], c: SqlConnection, _now: int) -> int:
        for one in some:
            stored = versions.stored(c, "stored_version", one.layer, one.tile, version=one.version)
            if stored is None:
                continue
            store.whole(stored).decode()
            sign_again(c, store.signing, stored)
        return len(some)

    groups = (found[at : at + SIGNED_TOGETHER] for at in range(0, len(found), SIGNED_TOGETHER))
    return sum(store.transact(partial(work, some)) for some in groups)


def sign_unsigned(store: SqlStore) -> int:
    """Sign all versions of a map that nobody has signed; how many. Errors as `sign_versions`."""
    found = [
        AnsweredVersion(stored.layer, stored.tile, stored.version, stored.kind, "unsigned")
        for layer in store.layers()
        for head in store.heads(layer)
        for line in store.history(layer, head.tile)
        if (stored := store.get(layer, head.tile, line.version)) is not None and stored.signature is None
    ]
    return sign_versions(store, found)
