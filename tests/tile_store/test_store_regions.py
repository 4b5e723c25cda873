"""Regions: prefixes as ranges of tiles, and wildcard keys; and what people may type for a tile or a time."""

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from store_helpers import TILE

from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import BadKey
from gnd.tile_store.arguments import parse_tile, parse_time_ns, parse_versions
from gnd.tile_store.errors import StoreError
from gnd.tile_store.regions import ALL_TILES, TileRegion, morton_range

ROOT = "gnd/v1/tile/"
tiles = st.integers(0, 2**39 - 1).map(TileId)


@given(tiles, st.integers(0, 23))
def test_a_prefix_is_the_range_of_the_tiles_that_begin_with_it(tile: TileId, length: int) -> None:
    prefix = tile.path[:length]
    first, end = morton_range(prefix)
    assert first <= tile.morton < end
    digits = len(prefix.replace("/", ""))
    assert end - first == 4 ** (20 - digits)
    if digits and end < 2**39:
        assert not TileId(end).path.replace("/", "").startswith(prefix.replace("/", ""))


def test_no_prefix_is_everywhere() -> None:
    assert morton_range("") == ALL_TILES


@given(tiles, st.lists(st.sampled_from(["keep", "*", "**"]), min_size=5, max_size=5))
def test_a_wildcard_made_from_a_key_matches_it(tile: TileId, choices: list[str]) -> None:
    names = ["ndt", *tile.path.split("/")]
    key = ROOT + "/".join(name if choice == "keep" else choice for name, choice in zip(names, choices, strict=True))
    region = TileRegion.of_key(key, ROOT)
    assert region.matches(*names)
    assert region.matches("ndt", *tile.path.split("/")) == as_regular_expression(key, names)
    first, end = morton_range(region.prefix)
    assert first <= tile.morton < end


@given(st.lists(st.sampled_from(["00000", "11111", "*", "**"]), min_size=1, max_size=5), st.integers(0, 31))
def test_matching_agrees_with_a_regular_expression(chunks: list[str], bits: int) -> None:
    names = ["00000" if bits >> i & 1 else "11111" for i in range(4)]
    region = TileRegion(("ndt", *chunks))
    key = ROOT + "/".join(("ndt", *chunks))
    assert region.matches("ndt", *names) == as_regular_expression(key, ["ndt", *names])


@given(tiles, st.lists(st.sampled_from(["keep", "*", "**"]), min_size=1, max_size=5))
def test_a_region_that_is_a_prefix_holds_every_tile_below_it(tile: TileId, choices: list[str]) -> None:
    names = ["ndt", *tile.path.split("/")]
    region = TileRegion(
        tuple(name if choice == "keep" else choice for name, choice in zip(names, choices, strict=False))
    )
    assert not region.is_prefix or region.matches(*names)
    is_plain = set(choices[1:-1]) <= {"keep"} and len(choices) > 1 and choices[-1] == "**" and choices[0] != "**"
    assert region.is_prefix or not is_plain


def as_regular_expression(key: str, names: list[str]) -> bool:
    """Zenoh's rule as a regular expression: `*` is one chunk, `**` any number, zero included."""
    pattern = "".join("(/[^/]+)*" if c == "**" else "/[^/]+" if c == "*" else f"/{c}" for c in key.split("/"))
    return re.fullmatch(pattern, "/" + ROOT + "/".join(names)) is not None


def test_what_a_region_asks_for() -> None:
    region = TileRegion.of_key(ROOT + "ndt/13033/03021/**", ROOT)
    assert (region.layer, region.prefix) == ("ndt", "13033/03021")
    assert TileRegion.of_key(ROOT + "*/13033/*/23031/*", ROOT).prefix == "13033"
    assert TileRegion.of_key(ROOT + "**", ROOT).prefix == ""
    assert TileRegion.of_key(ROOT + "**", ROOT).layer is None


@pytest.mark.parametrize("bad", ["gnd/**", "gnd/v1/tile/ndt/13$*/**", "gnd/v1/tile/NDT/**", "gnd/v1/tile/ndt/1303/**"])
def test_a_region_that_no_key_is_in_is_refused(bad: str) -> None:
    with pytest.raises(BadKey, match="region"):
        TileRegion.of_key(bad, ROOT)


def test_a_tile_can_be_typed_in_three_ways() -> None:
    assert parse_tile("13033/03021/23031/22102") == TILE
    assert parse_tile("497353963154") == TILE
    lat, lon = TILE.centre_rad
    assert parse_tile(f"{math.degrees(lat)},{math.degrees(lon)}") == TILE


@pytest.mark.parametrize("bad", ["", "x", "1,2,3", "91,0", "13033/03021", "-1", "549755813888", "nan,nan"])
def test_what_is_no_tile_is_refused_with_examples(bad: str) -> None:
    with pytest.raises(StoreError, match="13033/03021/23031/22102"):
        parse_tile(bad)


def test_times_and_versions() -> None:
    assert parse_time_ns("1970-01-01T00:00:01Z") == 1_000_000_000
    assert parse_time_ns("1970-01-01") == 0
    assert parse_time_ns("2026-01-31T12:00:00.000001+01:00") == 1_769_857_200_000_001_000
    assert parse_versions("3..5") == (3, 5)
    for bad in ("yesterday", ""):
        with pytest.raises(StoreError, match="time"):
            parse_time_ns(bad)
    for bad in ("3", "a..b", "3...5"):
        with pytest.raises(StoreError, match="versions"):
            parse_versions(bad)
