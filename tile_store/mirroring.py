"""A store as a mirror of another: versions as they were published there, with their numbers and signatures.

Nothing is merged in a mirror; a tile server may serve it, and whoever asks that one can check what he gets as if the
first had sent it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from gnd.fleet_bus.errors import SealError
from gnd.fleet_bus.publishers import Publishers
from gnd.gnd_map.content import AnyTile, day_of_tile
from gnd.gnd_map.day import UNKNOWN_DAY, ns_of
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas.catalog_signature import CatalogSignature, CatalogStatement
from gnd.schemas.tiles import TileBlob
from gnd.schemas.version_signature import VersionSignature
from gnd.tile_store import sql_catalogs as catalogs
from gnd.tile_store import sql_journal as journal
from gnd.tile_store.connection import SqlConnection, change, fetch, post
from gnd.tile_store.errors import StoreError
from gnd.tile_store.provenance import NOTHING, encode_provenance
from gnd.tile_store.signing import NOT_SIGNED
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.values import NS_PER_S, check_fits


@dataclass(frozen=True, slots=True)
class MirroredTile:
    """A version that another store has published.

    Attributes:
        tile: its content, checked.
        blob: the same as it came.
        signature: of who answers for it; None: nobody does.
        chain: the certificates behind the signature (`PublisherKey.sign`); b"": none.
    """

    tile: AnyTile
    blob: TileBlob
    signature: VersionSignature | None
    chain: bytes = b""


def check_mirror(store: SqlStore) -> None:
    """StoreError where a store takes reports: what it merges itself would meet what is mirrored."""
    if store.counts().reports:
        raise StoreError(f"{store.location}: takes reports of its own and is no mirror; choose another file")


def mirror(store: SqlStore, layer: str, tiles: Sequence[MirroredTile]) -> None:
    """Put versions into a mirror, all or none.

    Raises:
        StoreError: a version is older than the one that is there, or has its number and another content.
    """
    for one in tiles:
        check_fits(one.tile, layer)

    def work(c: SqlConnection, now: int) -> None:
        for one in tiles:
            _put(c, layer, one, now)

    store.transact(work)


def mirror_catalog(
    store: SqlStore, publishers: Publishers, layer: str, district: District, signature: CatalogSignature, chain: bytes
) -> bool:
    """Keep who answers for the catalog of a district; False: it does not fit what is here, where a part is missing or
    newer, and is not kept.

    Args:
        store: a mirror.
        publishers: whose signatures count.
        layer: of the map.
        district: of the layer.
        signature: of the catalog.
        chain: the certificates behind it.
    """

    def work(c: SqlConnection, _now: int) -> bool:
        here = CatalogStatement.of(layer, district, catalogs.released_of(c, layer, district))
        state = catalogs.CatalogState(here, signature)
        if catalogs.state_of(c, layer, district) == state:
            return True
        post(c, "put_publisher", {"signer": signature.signer, "chain": chain, "since_s": signature.signed_s})
        try:
            catalogs.who_signed_catalog(c, publishers, state)
        except SealError:
            return False
        catalogs.keep(c, state)
        return True

    return store.transact(work)


def _put(c: SqlConnection, layer: str, one: MirroredTile, now: int) -> None:
    blob, signature = one.blob, one.signature
    place = {"layer": layer, "tile": blob.tile.morton}
    head = fetch(c, "head", place)
    before, sha = (head[0][0], head[0][2]) if head else (0, b"")
    if before == blob.version and sha == blob.sha:
        return
    if before >= blob.version:
        raise StoreError(
            f"tile {TileId(blob.tile.morton).path} of layer {layer}: version {blob.version} came, and version {before}"
            " is here: an older state, or a store that was built anew; in that case fetch into another file"
        )
    row = place | {
        "version": blob.version,
        "parent": before,
        "kind": "base" if signature is None else signature.kind,
        "created_ns": now if signature is None else signature.made_s * NS_PER_S,
        "merger": "",
        "n_reports": 0,
        "sha": blob.sha,
        "codec_id": blob.codec_id,
        "size_bytes": len(blob.body),
        "provenance": encode_provenance(NOTHING),
        "body": blob.body,
        "body_check": None,  # it comes from elsewhere: it is read before it is sent
        "epoch": blob.version,
    }
    post(c, "insert_version", row | _signed(c, one))
    catalogs.forget(c, layer, blob.tile.district)  # until the whole district has come (`mirror_catalog`)
    if change(c, "swap_head" if before else "insert_head", row) != 1:
        raise StoreError(f"tile {blob.tile.path} of layer {layer}: head {before} has moved inside a transaction")
    journal.begin_epoch(c, layer, blob.tile, blob.version)
    day = day_of_tile(one.tile)
    if row["kind"] != "merged" and day != UNKNOWN_DAY:
        change(c, "put_survey", place | {"version": blob.version, "surveyed_ns": ns_of(day)})


def _signed(c: SqlConnection, one: MirroredTile) -> dict[str, object]:
    signature = one.signature
    if signature is None:
        return dict(NOT_SIGNED)
    post(c, "put_publisher", {"signer": signature.signer, "chain": one.chain, "since_s": signature.signed_s})
    return {"signer": signature.signer, "signed_s": signature.signed_s, "signature": signature.signature}
