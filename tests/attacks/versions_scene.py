"""A signed store, and a tile server that was broken into: it has its own good certificate and answers what it likes."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from signing_scene import Authority
from suite_ports import new_port

from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.errors import NotMine
from gnd.fleet_bus.router import open_router
from gnd.fleet_bus.serving import Request
from gnd.gnd_map.codec import LATTICES, snap
from gnd.gnd_map.content import encode_content
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas import keys
from gnd.schemas.district_list import HEAD_ONLY, DistrictList
from gnd.schemas.tiles import Catalog
from gnd.schemas.tiles_batch import TileAnswer, TilesReply, TilesRequest
from gnd.schemas.version_signature import VersionSignature, VersionStatement
from gnd.tile_client.checking import VersionCheck
from gnd.tile_client.exchange import Exchange, ExchangeOutcome
from gnd.tile_store.answers import TileAnswers
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.link.cache import TileCache

FIRST = TileId(497353963154 & ~1023)
LAYER = "ndt"
Alter = Callable[[TileId, TileAnswer], TileAnswer]
AlterCatalog = Callable[[Catalog], Catalog]
AlterLists = Callable[[DistrictList], list[DistrictList]]


def content(tile: TileId, seed: int, count: int = 40) -> Tile:
    """A tile of some Gaussians; another seed is another world."""
    rng = np.random.default_rng(seed)
    ids = np.sort(rng.choice(1500, count, replace=False)).astype(np.int32)
    covariance = np.tile(np.array([0.05, 0.0, 0.0, 0.05, 0.0, 0.05], np.float32), (count, 1))
    gaussians = Gaussians(
        voxel_id=ids,
        count=rng.integers(20, 200, count).astype(np.int32),
        cells=np.full(count, 20, np.int32),
        mean_m=rng.uniform(-0.3, 0.3, (count, 3)).astype(np.float32),
        cov_m2=covariance,
    )
    return Tile(tile, 1, snap(gaussians, LATTICES["standard"], new_map=True))


@dataclass
class BrokenServer:
    """Answers from the store, altered: the seal of each answer is good."""

    bus: Bus
    store: SqliteStore
    alter: Alter | None = None
    alter_catalog: AlterCatalog | None = None
    alter_lists: AlterLists | None = None
    beside: Callable[[District, Catalog], Catalog | None] = lambda _district, said: said
    """What it says of other districts; None: nothing."""
    strange: dict[District, Catalog] = field(default_factory=dict)
    """Of districts that its store has not."""
    asked: list[bytes] = field(default_factory=list)
    """Payloads of questions after lists of districts."""
    chains: dict[str, bytes] = field(default_factory=dict)
    """What it shows for ids of certificates that the store has not."""

    def __post_init__(self) -> None:
        self._answers = TileAnswers(self.store)
        self.bus.serve(keys.batch_keys(), self.batch, complete=True, kind="tile")
        self.bus.serve("gnd/v1/catalog/**", self.catalog, complete=True, kind="catalog")
        self.bus.serve("gnd/v1/certificate/*", self.certificate, kind="control")

    def batch(self, request: Request) -> bytes:
        layer, district = keys.parse_batch_key(request.key)
        wanted = TilesRequest.decode(request.payload)
        asked = wanted.by_district(district)
        reply = self._answers.many(layer, district, wanted, asked)
        told = reply.by_district(wanted, district)
        first, *others = (self._altered(one, asked[one], part) for one, part in told.items())
        return replace(first, others=tuple(others)).encode()

    def _altered(self, district: District, request: TilesRequest, reply: TilesReply) -> TilesReply:
        if self.alter is None:
            return reply
        pairs = reply.of_request(request, district)
        return TilesReply(tuple(self.alter(tile, answer) for tile, answer in pairs))

    def catalog(self, request: Request) -> list[tuple[str, bytes]]:
        if keys.layer_of_lists(request.key):
            self.asked.append(request.payload)
            return self.lists(request.payload)
        true = self.store.catalog(LAYER, FIRST.district)
        said = true if self.alter_catalog is None else self.alter_catalog(true)
        others = sorted({head.tile.district for head in self.store.heads(LAYER)} - {FIRST.district})
        told = (
            {one: self.beside(one, self.store.catalog(LAYER, one)) for one in others}
            | {FIRST.district: said}
            | self.strange
        )
        named = ((keys.catalog_key(LAYER, district), one) for district, one in told.items())
        asked = request.key.removesuffix("**")
        return [(key, one.encode()) for key, one in named if one is not None and f"{key}/".startswith(asked)]

    def lists(self, payload: bytes) -> list[tuple[str, bytes]]:
        true = self.store.district_list(LAYER)
        assert true is not None
        said = [true] if self.alter_lists is None else self.alter_lists(true)
        told = [one.without_districts if payload == HEAD_ONLY else one for one in said]
        return [(keys.list_key(LAYER, one.head.region), one.encode()) for one in told]

    def certificate(self, request: Request) -> bytes:
        name = request.key.rpartition("/")[2]
        chain = self.chains.get(name) or self.store.publisher_chain(bytes.fromhex(name))
        if chain is None:
            raise NotMine
        return chain


@dataclass
class VersionScene:
    """A router, a store signed by an operator and a shard, the broken server, a vehicle and a watcher."""

    folder: Path
    endpoint: str
    authority: Authority
    parts: dict[str, Path]
    store: SqliteStore
    server: BrokenServer
    vehicle: Bus
    watcher: Bus
    taken: int = 0

    @property
    def path(self) -> Path:
        return self.store.path

    def tile(self, *seeds: int) -> TileId:
        """A tile that no other test has: the first content by the operator, later ones by the shard."""
        tile = TileId(FIRST.morton + self.taken)
        self.taken += 1
        for number, seed in enumerate(seeds):
            self.publish("operator" if number == 0 else "shard", content(tile, seed))
        return tile

    def publish(self, part: str, tile: Tile) -> None:
        with SqliteStore(self.path, create=False, signing=Signing(self.parts[part])) as store:
            store.put_tiles([tile])

    def client(self, cache: str, ticket: int = 0) -> "Client":
        return Client(self.vehicle, TileCache(self.folder / f"{cache}.sqlite", LAYER), ticket)

    def signed_by(self, folder: Path, statement: VersionStatement, signed_s: int | None = None) -> VersionSignature:
        """The signature of any certificate, also of one that may not sign; its chain is shown to who asks."""
        from gnd.fleet_bus.seal_keys import load_signer
        from gnd.fleet_bus.seals import SIGNATURE_BYTES

        signer = load_signer(folder)
        at_s = statement.made_s if signed_s is None else signed_s
        self.server.chains[signer.certificate_id.hex()] = signer.chain
        signature = raw_signature(folder, statement.text(signer.certificate_id, at_s))
        assert len(signature) == SIGNATURE_BYTES
        return VersionSignature(signer.certificate_id, statement.kind, statement.made_s, at_s, signature)


@dataclass
class Client:
    """A vehicle that asks: its cache, and what came of the last question."""

    bus: Bus
    cache: TileCache[Tile]
    ticket: int = 0

    def __post_init__(self) -> None:
        self.check = VersionCheck.on_the_bus(self.bus, LAYER, self.cache)
        self.exchange: Exchange[Tile] = Exchange(self.bus, self.cache, 10.0, ticket=self.ticket, check=self.check)

    def ask(self, tile: TileId) -> ExchangeOutcome[Tile]:
        return self.exchange.ask([tile], (), 1_000_000)

    def version(self, tile: TileId) -> int:
        """What the vehicle holds after asking."""
        self.ask(tile)
        return self.cache.head(tile)[0]

    def refuses(self, tile: TileId, why: str) -> None:
        """Nothing is taken, and the reason says this."""
        before = self.cache.head(tile)
        outcome = self.ask(tile)
        assert why in outcome.wrong.get(tile, "taken"), outcome
        assert self.cache.head(tile) == before
        assert outcome.fetched == []


def raw_signature(folder: Path, text: bytes) -> bytes:
    """ECDSA, made with `cryptography` alone."""
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec, utils
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    key = load_pem_private_key((folder / "key.pem").read_bytes(), password=None)
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    r, s = utils.decode_dss_signature(key.sign(text, ec.ECDSA(hashes.SHA256())))
    return r.to_bytes(32, "big") + s.to_bytes(32, "big")


def whole(tile: Tile, version: int, signature: VersionSignature | None) -> TileAnswer:
    """An answer that brings a tile whole."""
    return TileAnswer("blob", version, tile.sha[:4], *encode_content(tile), tile.day, signature)


def with_signature(answer: TileAnswer, **changes: object) -> TileAnswer:
    """The same answer, its signature's fields changed."""
    assert answer.signature is not None
    return replace(answer, signature=replace(answer.signature, **changes))  # type: ignore[arg-type]


@contextmanager
def version_scene(folder: Path) -> Iterator[VersionScene]:
    authority = Authority(folder / "parts")
    names = {"tiles": "t1", "shard": "s1", "operator": "o1", "vehicle": "v1"}
    parts = {role: authority.part(role, name) for role, name in names.items()}
    parts["watcher"] = authority.part("operator", "w1")
    endpoint = f"tcp/127.0.0.1:{new_port()}"
    path = folder / "map.sqlite"
    with (
        SqliteStore(path) as store,
        open_router([endpoint]),
        open_bus(BusConfig(connect=(endpoint,), identity=parts["tiles"]), name="tiles") as tiles,
        open_bus(BusConfig(connect=(endpoint,), identity=parts["vehicle"]), name="v1") as vehicle,
        open_bus(BusConfig(connect=(endpoint,), identity=parts["watcher"]), name="w1") as watcher,
    ):
        server = BrokenServer(tiles, store)
        yield VersionScene(folder, endpoint, authority, parts, store, server, vehicle, watcher)
