"""What signatures of tile versions weigh on the way, and what making and checking them costs."""

import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np

from gnd.deploy.chaos.street import read_street
from gnd.fleet_bus.identity.authority import Authority
from gnd.fleet_bus.identity.names import MemberName
from gnd.fleet_bus.publishers import Publishers
from gnd.gnd_map.content import encode_content_delta
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TILES_OF_DISTRICT, TileId
from gnd.schemas.catalog_signature import CatalogStatement
from gnd.schemas.tiles_batch import HeldVersion, TileAnswer, TilesReply, TilesRequest
from gnd.schemas.version_signature import VersionSignature
from gnd.tile_store.answers import TileAnswers
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoredTile
from studies.frame.measure import Figure, core_s

CALLS = 400
CATALOG_CALLS = 300
ROUNDS = 9
CHANGED_SHARE = 0.05


def run() -> list[Figure]:
    """Measure on the tiles of a street: bytes, processor time of a signature, of a check, of a publication."""
    tiles = read_street().tiles
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        authority = Authority.create(folder / "authority", "study")
        authority.issue(MemberName("shard", "s"), folder / "shard")
        signing = Signing(folder / "shard")
        with SqliteStore(folder / "signed.sqlite", signing=signing) as store:
            store.put_tiles(tiles)
            signed = [one for tile in tiles if (one := store.get("ndt", tile.tile_id)) is not None]
            chain = store.publisher_chain(signed[0].signature.signer) if signed[0].signature else None
            unchanged = _reply_where_nothing_is_new(store)
        with SqliteStore(folder / "plain.sqlite") as store:
            store.put_tiles(tiles)
            bare = _reply_where_nothing_is_new(store)
        assert chain is not None
        return [
            *_bytes(signed, tiles),
            Figure("signatures where nothing is new", float(unchanged - bare), "B", f"a reply of {bare} B in all"),
            *_work(signing, signed, Publishers(folder / "shard"), chain),
            *_catalogs(folder, signing, tiles[0]),
            *_publications(folder, signing, tiles),
        ]


def _bytes(signed: Sequence[StoredTile], tiles: Sequence[Tile]) -> list[Figure]:
    bodies = [len(one.body) for one in signed]
    alone = [_more([one]) for one in _whole(signed)]
    together = _more(_whole(signed)) / len(signed)
    deltas = [_delta(one, tile) for one, tile in zip(signed, tiles, strict=True)]
    sizes = [len(one.body) for one in deltas]
    worst = max(more / body for more, body in zip(alone, bodies, strict=True))
    count = f"{len(signed)} tiles of 38 m"
    return [
        Figure("body of a tile, mean", float(np.mean(bodies)), "B", f"{count}, {min(bodies)} to {max(bodies)}"),
        Figure("signature of a tile in a reply of many", together, "B", f"{100 * together / np.mean(bodies):.1f} %"),
        Figure("signature of a tile alone, worst", float(max(alone)), "B", f"{100 * worst:.1f} % of the smallest body"),
        Figure("delta of a tile, mean", float(np.mean(sizes)), "B", f"{100 * CHANGED_SHARE:g} % of its voxels changed"),
        Figure("signature beside a delta in a reply of many", _more(deltas) / len(deltas), "B"),
    ]


def _reply_where_nothing_is_new(store: SqliteStore) -> int:
    """Bytes of the tile server's answer to who holds a whole district already."""
    heads = store.heads("ndt")
    here = [head for head in heads if head.tile.district == heads[0].tile.district]
    request = TilesRequest.of([HeldVersion(head.tile, head.version, head.sha) for head in here])
    reply = TileAnswers(store).many("ndt", heads[0].tile.district, request)
    return len(reply.encode())


def _catalogs(folder: Path, signing: Signing, tile: Tile) -> list[Figure]:
    """What the signature under the catalog of a full district weighs and costs: 1,024 small tiles."""
    district, some = tile.tile_id.district, [tile.gaussians.take(np.arange(n)) for n in (4, 5, 6, 7)]
    spent: dict[str, list[float]] = {}
    for name, signs in (("plain", None), ("signed", signing)):
        with SqliteStore(folder / f"full_{name}.sqlite", signing=signs) as store:
            store.put_tiles([Tile(one, 1, some[-1]) for one in district.tiles()])
            begins = [time.process_time()]
            for n in range(CATALOG_CALLS):
                store.put_tiles([Tile(TileId(district.first_morton + n % TILES_OF_DISTRICT), 1, some[n % 3])])
                begins.append(time.process_time())
            spent[name] = np.diff(begins).tolist()
            catalog = store.catalog("ndt", district)
            whole_s = core_s(lambda store=store: store.catalog("ndt", district))  # type: ignore[misc]
    bytes_signed = len(catalog.encode())
    statement_s = core_s(lambda: CatalogStatement.of("ndt", district, catalog.entries))
    before, after = (1e6 * median(spent[name]) for name in ("plain", "signed"))
    more = float(bytes_signed - len(replace(catalog, signature=None).encode()))
    return [
        Figure("signature of a catalog", more, "B", f"{100 * more / bytes_signed:.1f} % of one of 1,024 tiles"),
        Figure("publishing into a full district, not signed", before, "us of CPU"),
        Figure("publishing into a full district, version and catalog signed", after, "us of CPU",
               f"{after - before:+.0f} us"),
        Figure("reading a catalog of 1,024 tiles", 1e6 * whole_s, "us of CPU"),
        Figure("computing the root of 1,024 tiles", 1e6 * statement_s, "us of CPU", "by a client, beside a check"),
    ]  # fmt: skip


def _whole(signed: Sequence[StoredTile]) -> list[TileAnswer]:
    return [
        TileAnswer("blob", one.version, one.sha[:4], one.codec_id, one.body, one.day, one.signature) for one in signed
    ]


def _delta(one: StoredTile, tile: Tile) -> TileAnswer:
    g, rng = tile.gaussians, np.random.default_rng(tile.tile_id.morton)
    kept = np.flatnonzero(rng.uniform(size=len(g)) >= CHANGED_SHARE)
    after = Tile(tile.tile_id, 2, g.take(kept))
    return TileAnswer("delta", 2, after.sha[:4], 0, encode_content_delta(tile, after), one.day, one.signature)


def _more(answers: Sequence[TileAnswer]) -> int:
    """Bytes by which signatures make a reply longer."""
    bare = [TileAnswer(a.status, a.version, a.sha, a.codec_id, a.body, a.day) for a in answers]
    return len(TilesReply(tuple(answers)).encode()) - len(TilesReply(tuple(bare)).encode())


def _work(signing: Signing, signed: Sequence[StoredTile], publishers: Publishers, chain: bytes) -> list[Figure]:
    some = [signed[n % len(signed)] for n in range(CALLS)]
    checked: list[tuple[VersionSignature, StoredTile]] = [(one.signature, one) for one in some if one.signature]

    def check() -> None:
        for signature, one in checked:
            text = one.statement.text(signature.signer, signature.signed_s)
            publishers.check(signature.signer, signature.signed_s, text, signature.signature)

    learn_s = core_s(lambda: publishers.learn(chain))
    sign_s = core_s(lambda: [signing.sign(one.statement) for one in some], ROUNDS) / CALLS
    return [
        Figure("signing a version", 1e6 * sign_s, "us of CPU"),
        Figure("checking a version", 1e6 * core_s(check, ROUNDS) / CALLS, "us of CPU"),
        Figure("taking a signer's certificates", 1e6 * learn_s, "us of CPU", "once a signer and process"),
        Figure("certificates of a signer", float(len(chain)), "B", "once a signer and process"),
        Figure("decoding a body, for comparison", 1e6 * core_s(lambda: [one.decode() for one in signed]) / len(signed),
               "us of CPU"),
    ]  # fmt: skip


def _publications(folder: Path, signing: Signing, tiles: Sequence[Tile]) -> list[Figure]:
    """The same versions into two stores in turns: processor time of all threads for each version."""
    spent: dict[str, list[float]] = {"plain": [], "signed": []}
    with (
        SqliteStore(folder / "a.sqlite") as plain,
        SqliteStore(folder / "b.sqlite", signing=signing) as with_signatures,
    ):
        for number in range(ROUNDS):
            changed = [_without(tile, number) for tile in tiles]
            for name, store in (("plain", plain), ("signed", with_signatures)):
                begin_s = time.process_time()
                for tile in changed:
                    store.put_tiles([tile])
                spent[name].append((time.process_time() - begin_s) / len(tiles))
    before, after = (1e6 * median(spent[name]) for name in ("plain", "signed"))
    return [
        Figure("publishing a version, not signed", before, "us of CPU", "encoding, hash, SQLite"),
        Figure("publishing a version, signed", after, "us of CPU", f"{100 * (after / before - 1):+.0f} %"),
    ]


def _without(tile: Tile, number: int) -> Tile:
    g = tile.gaussians
    return Tile(tile.tile_id, 1, g.take(np.delete(np.arange(len(g)), number % len(g))))
