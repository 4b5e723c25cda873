"""Keys: written and read back, regions, refusals; and the protocol's document says what the table says."""

import contextlib
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnd.gnd_map.tile_id import TileId
from gnd.schemas import keys
from gnd.schemas.errors import BadKey, WrongVersion

TILE = TileId(497353963154)
PATH = "13033/03021/23031/22102"
tiles = st.integers(0, 2**39 - 1).map(TileId)
names = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}", fullmatch=True)


def test_the_keys_of_figure_2s_tile() -> None:
    assert keys.tile_key("ndt", TILE) == f"gnd/v1/tile/ndt/{PATH}"
    assert keys.update_key("ndt", TILE) == f"gnd/v1/update/ndt/{PATH}"
    assert keys.catalog_key("ndt", TILE.district) == "gnd/v1/catalog/ndt/13033/03021/23031"
    assert keys.change_key("signs", TILE.district) == "gnd/v1/change/signs/13033/03021/23031"
    assert keys.traffic_key("car-1") == "gnd/v1/traffic/car-1"
    assert keys.alive_key("merger", "shard-0") == "gnd/v1/alive/merger/shard-0"


def test_wildcards() -> None:
    assert keys.update_keys("ndt", "13033/03021") == "gnd/v1/update/ndt/13033/03021/**"
    assert keys.tiles_key("ndt") == "gnd/v1/tile/ndt/**"
    assert keys.tiles_key("ndt", PATH) == f"gnd/v1/tile/ndt/{PATH}"
    assert keys.change_keys() == "gnd/v1/change/**"
    assert keys.change_keys("ndt") == "gnd/v1/change/ndt/**"
    assert keys.catalog_keys("ndt") == "gnd/v1/catalog/ndt/**"
    assert keys.traffic_keys() == "gnd/v1/traffic/*"
    assert keys.alive_keys("merger") == "gnd/v1/alive/merger/*"


@given(tiles)
def test_any_tile_is_read_back_from_its_keys(tile: TileId) -> None:
    assert keys.parse_tile_key(keys.tile_key("ndt", tile)) == ("ndt", tile)
    assert keys.parse_update_key(keys.update_key("signs", tile)) == ("signs", tile)
    assert keys.parse_catalog_key(keys.catalog_key("ndt", tile.district)) == ("ndt", tile.district)
    assert keys.parse_change_key(keys.change_key("ndt", tile.district)) == ("ndt", tile.district)
    assert keys.parse_list_key(keys.list_key("ndt", "main")) == ("ndt", "main")
    assert keys.layer_of_lists(keys.list_keys("ndt")) == "ndt"
    assert keys.layer_of_lists(keys.catalog_keys("ndt")) is keys.layer_of_lists(keys.list_key("ndt", "a")) is None


@given(tiles, st.integers(0, 4))
def test_any_region_is_read_back(tile: TileId, chunks: int) -> None:
    prefix = "/".join(tile.path.split("/")[:chunks])
    assert keys.parse_tiles_key(keys.tiles_key("ndt", prefix)) == ("ndt", prefix)


@given(names, names)
def test_any_vehicle_and_member_is_read_back(vehicle: str, member: str) -> None:
    assert keys.parse_traffic_key(keys.traffic_key(vehicle)) == vehicle
    assert keys.parse_alive_key(keys.alive_key("agent", member)) == ("agent", member)


PARSERS: dict[str, Callable[[str], object]] = {
    "tile": keys.parse_tile_key,
    "tiles": keys.parse_tiles_key,
    "update": keys.parse_update_key,
    "catalog": keys.parse_catalog_key,
    "change": keys.parse_change_key,
    "traffic": keys.parse_traffic_key,
    "alive": keys.parse_alive_key,
}


@pytest.mark.parametrize("parser", PARSERS.values(), ids=PARSERS)
def test_another_major_version_is_refused_clearly(parser: Callable[[str], object]) -> None:
    with pytest.raises(WrongVersion, match="is of major version 2; this program speaks 1"):
        parser("gnd/v2/anything/at/all")


@pytest.mark.parametrize("parser", PARSERS.values(), ids=PARSERS)
@given(key=st.one_of(st.text(max_size=60), st.from_regex(r"gnd/v1/(tile|change|alive)(/[^/]*){0,6}", fullmatch=True)))
def test_any_other_key_is_refused_or_understood(parser: Callable[[str], object], key: str) -> None:
    with contextlib.suppress(BadKey, WrongVersion):
        parser(key)


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("gnd/v1/tile/ndt/13033/03021/23031", r"is not gnd/v1/tile/<layer>/<q5>/<q10>/<q15>/<q20>"),
        ("gnd/v1/tile/ndt/13033/03021/23031/22104", r"'13033/03021/23031/22104' is no tile path"),
        ("gnd/v1/tile/ndt/33033/03021/23031/22102", r"first digit 0 or 1"),
        ("gnd/v1/tile/NDT/13033/03021/23031/22102", r"layer 'NDT' does not match"),
        ("gnd/v1/tile/ndt/13033/03021/23031/*", r"is no tile path"),
        ("gnd/v1/change/ndt/13033/03021/23031", r"is not gnd/v1/tile"),
        ("gnd/vx/tile/ndt/13033/03021/23031/22102", r"is not gnd/v1/tile"),
        ("gnd", r"is not gnd/v1/tile"),
    ],
)
def test_a_bad_tile_key_is_refused_with_what_is_wrong(key: str, message: str) -> None:
    with pytest.raises(BadKey, match=message):
        keys.parse_tile_key(key)


@pytest.mark.parametrize("prefix", ["1303", "13033/", "13033/*", "13033/03021/23031/22102/00000", "23033", "**"])
def test_a_region_is_whole_chunks(prefix: str) -> None:
    with pytest.raises(BadKey, match="region prefix"):
        keys.tiles_key("ndt", prefix)


@pytest.mark.parametrize("vehicle", ["", "a/b", "*", "a b", "-a", "é", "a" * 65])
def test_a_vehicle_is_one_chunk_of_plain_letters(vehicle: str) -> None:
    with pytest.raises(BadKey, match="vehicle"):
        keys.traffic_key(vehicle)


def test_the_protocols_document_holds_the_table_as_it_is() -> None:
    document = (Path(__file__).parents[2] / "docs" / "protocol.md").read_text()
    for spec in keys.KEY_TABLE:
        row = f"| `{spec.pattern}` | {spec.kind} | {spec.request} | {spec.reply} | {spec.reliability} |"
        assert row in document, f"docs/protocol.md lacks the row {row}"
