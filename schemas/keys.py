"""The one table of key expressions; no key string stands anywhere else.

A tile is written as its 20-level path in four chunks of five base-4 digits, `q5/q10/q15/q20` (about 1250 km, 39 km,
1.2 km, 38 m), so that a prefix is a region and a wildcard over whole chunks a subscription to it.
"""

import re
from dataclasses import dataclass
from typing import Final

from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas.errors import BadKey, WrongVersion
from gnd.schemas.wire import LAYER_PATTERN, MAJOR, VEHICLE_PATTERN, WORD_PATTERN, refusing

ROOT: Final = f"gnd/v{MAJOR}"


@dataclass(frozen=True, slots=True)
class KeySpec:
    """One row of the table: what is said on a key, in which direction, how surely it arrives."""

    pattern: str
    kind: str
    request: str
    reply: str
    reliability: str


KEY_TABLE: Final = (
    KeySpec(
        pattern=f"{ROOT}/tile/<layer>/<q5>/<q10>/<q15>/<q20>",
        kind="query, any client → tile server",
        request="TileRequest, or nothing",
        reply="TileReply",
        reliability="repeated until answered; a wildcard gets one reply per tile, at most 4,096",
    ),
    KeySpec(
        pattern=f"{ROOT}/tiles/<layer>/<q5>/<q10>/<q15>",
        kind="query, any client → tile server",
        request="TilesRequest",
        reply="TilesReply",
        reliability="repeated until answered; tiles that did not fit are requested again",
    ),
    KeySpec(
        pattern=f"{ROOT}/catalog/<layer>/<q5>/<q10>/<q15>",
        kind="query, any client → tile server",
        request="–",
        reply="Catalog",
        reliability="repeated until answered; a wildcard gets one reply per district",
    ),
    KeySpec(
        pattern=f"{ROOT}/catalog/<layer>/<region>",
        kind="query on <region> = *, any client → tile server",
        request="nothing; one byte 1: without the districts",
        reply="DistrictList",
        reliability="repeated until answered; one reply of each store that shares the map",
    ),
    KeySpec(
        pattern=f"{ROOT}/change/<layer>/<q5>/<q10>/<q15>",
        kind="query with payload, agent → merger shard",
        request="ChangeReport",
        reply="ChangeAck",
        reliability="durable before the acknowledgement; repeated under the same report id until acknowledged",
    ),
    KeySpec(
        pattern=f"{ROOT}/want/<vehicle>",
        kind="put, merger shard → agent, after the commit",
        request="ReportStates",
        reply="–",
        reliability="may be lost; the agent then queries its state key",
    ),
    KeySpec(
        pattern=f"{ROOT}/state/<vehicle>",
        kind="query, agent → merger shard",
        request="ReportQuestion",
        reply="ReportStates",
        reliability="repeated until the report is released",
    ),
    KeySpec(
        pattern=f"{ROOT}/update/<layer>/<q5>/<q10>/<q15>/<q20>",
        kind="put, merger → anyone, after the commit",
        request="TileUpdate",
        reply="–",
        reliability="dropped for subscribers that do not keep up; a late or lost notice is found through the catalog",
    ),
    KeySpec(
        pattern=f"{ROOT}/traffic/<vehicle>",
        kind="put, agent → anyone",
        request="TrafficSample",
        reply="–",
        reliability="totals: the next sample replaces a lost one",
    ),
    KeySpec(
        pattern=f"{ROOT}/health/<vehicle>",
        kind="put, agent → merger shards, while a version is on trial",
        request="HealthReport",
        reply="–",
        reliability="totals of a visit: the next message replaces a lost one",
    ),
    KeySpec(
        pattern=f"{ROOT}/live/<vehicle>/<topic>",
        kind="put, a vehicle's own sensors → its agent; query on <topic> = header",
        request="the message of a drive's topic (`/lidar/points`: lidar-points); –",
        reply="LiveHeader (JSON)",
        reliability="the newest counts; what is left out is counted",
    ),
    KeySpec(
        pattern=f"{ROOT}/alive/<role>/<id>",
        kind="liveliness token",
        request="–",
        reply="–",
        reliability="ends with its process at once, or after the lease if its machine fails",
    ),
    KeySpec(
        pattern=f"{ROOT}/authority/<list>",
        kind="put, operator → routers; `revoked` → everybody",
        request="`members`: MemberList (JSON, signed); `revoked`: CRL (PEM)",
        reply="–",
        reliability="the list with the highest number counts; also in the identity folder of each router",
    ),
)

_PREFIX = re.compile(r"(?:[01][0-3]{4}(?:/[0-3]{5}){0,3})?")


def tile_key(layer: str, tile: TileId) -> str:
    """Where one tile is asked for."""
    return f"{ROOT}/tile/{_layer(layer)}/{tile.path}"


def tiles_key(layer: str, prefix: str = "") -> str:
    """Where every tile of a region is asked for; `prefix` = none to four chunks of a tile's path."""
    return f"{ROOT}/tile/{_layer(layer)}/{_region(prefix)}"


def batch_key(layer: str, district: District) -> str:
    """Where tiles of one district are asked for together."""
    return f"{ROOT}/tiles/{_layer(layer)}/{district.path}"


def batch_keys() -> str:
    """Every key on which tiles are asked for together."""
    return f"{ROOT}/tiles/**"


def catalog_key(layer: str, district: District) -> str:
    """Where a district's catalog is asked for."""
    return f"{ROOT}/catalog/{_layer(layer)}/{district.path}"


def catalog_keys(layer: str, prefix: str = "") -> str:
    """The catalogs of a region; `prefix` = none to three chunks of a tile's path (a fourth is left out)."""
    return f"{ROOT}/catalog/{_layer(layer)}/{_region('/'.join(prefix.split('/')[:3]))}"


def list_key(layer: str, region: str) -> str:
    """Where the list of districts of a store's part of a layer is answered."""
    return f"{ROOT}/catalog/{_layer(layer)}/{_matching('region', region, VEHICLE_PATTERN)}"


def list_keys(layer: str) -> str:
    """Where the lists of districts of a layer are asked for."""
    return f"{ROOT}/catalog/{_layer(layer)}/*"


def layer_of_lists(key: str) -> str | None:
    """The layer of a question after lists of districts; None: it is no such key."""
    chunks = key.split("/")
    is_one = len(chunks) == 5 and key.startswith(f"{ROOT}/catalog/") and chunks[4] == "*"
    return chunks[3] if is_one and LAYER_PATTERN.fullmatch(chunks[3]) else None


def district_keys(district: District) -> tuple[str, str, str]:
    """Keys of all layers in one district: its tiles, several of them at once, its catalogs."""
    return (
        f"{ROOT}/tile/*/{district.path}/**",
        f"{ROOT}/tiles/*/{district.path}",
        f"{ROOT}/catalog/*/{district.path}",
    )


def change_key(layer: str, district: District) -> str:
    """Where a report over a district's tiles is sent."""
    return f"{ROOT}/change/{_layer(layer)}/{district.path}"


def change_keys(layer: str | None = None) -> str:
    """Every report's key: of one layer, or of all."""
    return f"{ROOT}/change/**" if layer is None else f"{ROOT}/change/{_layer(layer)}/**"


def update_key(layer: str, tile: TileId) -> str:
    """Where a tile's new versions are announced."""
    return f"{ROOT}/update/{_layer(layer)}/{tile.path}"


def update_keys(layer: str, prefix: str = "") -> str:
    """The updates of a region; `prefix` = none to four chunks of a tile's path."""
    return f"{ROOT}/update/{_layer(layer)}/{_region(prefix)}"


def want_key(vehicle: str) -> str:
    """Where a vehicle hears how far its reports have come."""
    return f"{ROOT}/want/{_matching('vehicle', vehicle, VEHICLE_PATTERN)}"


def state_key(vehicle: str) -> str:
    """Where a vehicle asks how far its reports have come."""
    return f"{ROOT}/state/{_matching('vehicle', vehicle, VEHICLE_PATTERN)}"


def state_keys() -> str:
    """Every key on which vehicles ask how far their reports have come."""
    return f"{ROOT}/state/*"


def traffic_key(vehicle: str) -> str:
    """Where a vehicle puts its traffic samples."""
    return f"{ROOT}/traffic/{_matching('vehicle', vehicle, VEHICLE_PATTERN)}"


def traffic_keys() -> str:
    """The traffic samples of every vehicle."""
    return f"{ROOT}/traffic/*"


def health_key(vehicle: str) -> str:
    """Where a vehicle tells how it fares on tiles on trial."""
    return f"{ROOT}/health/{_matching('vehicle', vehicle, VEHICLE_PATTERN)}"


def health_keys() -> str:
    """What every vehicle tells of tiles on trial."""
    return f"{ROOT}/health/*"


def live_key(vehicle: str, topic: str) -> str:
    """Where a vehicle's own sensors put the messages of a drive's topic, or "header", or "*"."""
    name = topic if topic == "*" else _matching("topic", topic.strip("/").replace("/", "-"), VEHICLE_PATTERN)
    return f"{ROOT}/live/{_matching('vehicle', vehicle, VEHICLE_PATTERN)}/{name}"


def alive_key(role: str, member: str) -> str:
    """The liveliness token of one process: its role (`agent`, `merger`, `store` ...) and its name."""
    return f"{ROOT}/alive/{_matching('role', role, WORD_PATTERN)}/{_matching('id', member, VEHICLE_PATTERN)}"


def alive_keys(role: str) -> str:
    """The liveliness tokens of every process in a role."""
    return f"{ROOT}/alive/{_matching('role', role, WORD_PATTERN)}/*"


def authority_key(name: str) -> str:
    """Where a list of the authority is put: "members" or "revoked"."""
    return f"{ROOT}/authority/{_matching('list', name, WORD_PATTERN)}"


def parse_tile_key(key: str) -> tuple[str, TileId]:
    """Layer and tile of a tile key; `BadKey`, `WrongVersion`."""
    return _layer_and_tile(key, "tile")


def parse_update_key(key: str) -> tuple[str, TileId]:
    """Layer and tile of an update key; `BadKey`, `WrongVersion`."""
    return _layer_and_tile(key, "update")


def parse_batch_key(key: str) -> tuple[str, District]:
    """Layer and district of a key for tiles of one district; `BadKey`, `WrongVersion`."""
    return _layer_and_district(key, "tiles")


def parse_catalog_key(key: str) -> tuple[str, District]:
    """Layer and district of a catalog key; `BadKey`, `WrongVersion`."""
    return _layer_and_district(key, "catalog")


def parse_list_key(key: str) -> tuple[str, str]:
    """Layer and region of the key of a list of districts; `BadKey`, `WrongVersion`."""
    layer, region = _chunks(key, "catalog", 2)
    return _layer(layer), _matching("region", region, VEHICLE_PATTERN)


def parse_change_key(key: str) -> tuple[str, District]:
    """Layer and district of a change key; `BadKey`, `WrongVersion`."""
    return _layer_and_district(key, "change")


def parse_traffic_key(key: str) -> str:
    """The vehicle of a traffic key; `BadKey`, `WrongVersion`."""
    (vehicle,) = _chunks(key, "traffic", 1)
    return _matching("vehicle", vehicle, VEHICLE_PATTERN)


def parse_health_key(key: str) -> str:
    """The vehicle of a health key; `BadKey`, `WrongVersion`."""
    (vehicle,) = _chunks(key, "health", 1)
    return _matching("vehicle", vehicle, VEHICLE_PATTERN)


def parse_state_key(key: str) -> str:
    """The vehicle of a state key; `BadKey`, `WrongVersion`."""
    (vehicle,) = _chunks(key, "state", 1)
    return _matching("vehicle", vehicle, VEHICLE_PATTERN)


def parse_alive_key(key: str) -> tuple[str, str]:
    """Role and name of a liveliness token; `BadKey`, `WrongVersion`."""
    role, member = _chunks(key, "alive", 2)
    return _matching("role", role, WORD_PATTERN), _matching("id", member, VEHICLE_PATTERN)


def parse_tiles_key(key: str) -> tuple[str, str]:
    """Layer and region prefix of a tile query, wildcard or not; `BadKey`, `WrongVersion`."""
    layer, *rest = _chunks(key, "tile")
    prefix = "/".join(rest[:-1] if rest[-1:] == ["**"] else rest)
    if _region(prefix) != "/".join(rest):
        raise BadKey(f"key {key[:160]!r}: a region is whole chunks of a tile's path, then /**")
    return _layer(layer), prefix


def _layer_and_tile(key: str, kind: str) -> tuple[str, TileId]:
    layer, *path = _chunks(key, kind, 5)
    with refusing(f"key {key[:160]!r}", BadKey):
        return _layer(layer), TileId.from_path("/".join(path))


def _layer_and_district(key: str, kind: str) -> tuple[str, District]:
    layer, *path = _chunks(key, kind, 4)
    with refusing(f"key {key[:160]!r}", BadKey):
        return _layer(layer), District("/".join(path))


def _chunks(key: str, kind: str, count: int | None = None) -> list[str]:
    """The chunks of `key` behind its kind; `count` None = any number of them, at least one."""
    chunks = key.split("/")
    if _is_other_major(chunks):
        raise WrongVersion(f"key {key[:160]!r} is of major version {chunks[1][1:]}; this program speaks {MAJOR}")
    rest = chunks[3:]
    if "/".join(chunks[:3]) != f"{ROOT}/{kind}" or not rest or count not in (None, len(rest)):
        raise BadKey(f"key {key[:160]!r} is not {_pattern(kind)}")
    return rest


def _is_other_major(chunks: list[str]) -> bool:
    return chunks[0] == "gnd" and len(chunks) > 1 and re.fullmatch(rf"v(?!{MAJOR}$)\d+", chunks[1]) is not None


def _pattern(kind: str) -> str:
    return next(spec.pattern for spec in KEY_TABLE if spec.pattern.startswith(f"{ROOT}/{kind}/"))


def _layer(layer: str) -> str:
    return _matching("layer", layer, LAYER_PATTERN)


def _region(prefix: str) -> str:
    """The key part for a region: the whole path of one tile, or a prefix of whole chunks and a wildcard."""
    _matching("region prefix", prefix, _PREFIX)
    return prefix if prefix.count("/") == 3 else f"{prefix}/**".removeprefix("/")


def _matching(name: str, text: str, pattern: re.Pattern[str]) -> str:
    if not pattern.fullmatch(text):
        raise BadKey(f"{name} {text[:80]!r} does not match {pattern.pattern}")
    return text
