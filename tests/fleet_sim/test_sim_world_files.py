"""World files that are damaged, wrong or absurd: refused by name and place."""

import json
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from sim_worlds import BOTH, small_world, thing

from gnd.fleet_sim import parts
from gnd.fleet_sim.errors import WorldError
from gnd.fleet_sim.shapes import Ball, Post
from gnd.fleet_sim.world import from_json, read_world, to_json

SMALL = small_world(
    thing("stays", BOTH, "kept", parts.slab(-3, 3, 8.0, 8.3, -0.2, 3.0), Post(1.0, 5.0, 0.1, 0.0, 3.0)),
    thing("moves", ("before",), "moved", parts.slab(-3, 3, -8.3, -8.0, -0.2, 3.0)),
    thing("moves", ("after",), "moved", parts.slab(-3, 3, -8.9, -8.6, -0.2, 3.0)),
    thing("comes", ("after",), "added", Ball(1.0, 6.0, 2.0, 0.5)),
)
TEXT = to_json(SMALL)


def shape_of(data: dict[str, Any], index: int = 1) -> dict[str, Any]:
    shape: dict[str, Any] = data["objects"][index]["shapes"][0]
    return shape


BREAK: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "other format": (lambda d: d.update(format="else"), "is not a world file"),
    "newer version": (lambda d: d.update(version=99), "version 99"),
    "unknown key": (lambda d: d.update(weather="fog"), "unknown weather"),
    "missing key": (lambda d: d.pop("slope"), "missing slope"),
    "missing objects": (lambda d: d.pop("objects"), "objects must be a list"),
    "objects are no list": (lambda d: d.update(objects=7), "objects must be a list, got 7"),
    "object is a number": (lambda d: d["objects"].__setitem__(2, 5), r"object 2 must be a JSON object, got 5"),
    "anchor is text": (lambda d: d.update(lat_rad="north"), "lat_rad must be a number .* got 'north'"),
    "anchor is true": (lambda d: d.update(lat_rad=True), "lat_rad must be a number .* got True"),
    "anchor is null": (lambda d: d.update(lon_rad=None), "lon_rad must be a number .* got None"),
    "anchor beyond the pole": (lambda d: d.update(lat_rad=2.0), "lat_rad must be in"),
    "anchor is not a number": (lambda d: d.update(height_m=float("nan")), "height_m must be a number"),
    "seed is a fraction": (lambda d: d.update(seed=1.5), "seed must be a whole number, got 1.5"),
    "length 1e9": (lambda d: d.update(half_length_m=1e9), "half_length_m must be a number of at most 1e"),
    "length 5 km": (lambda d: d.update(half_length_m=5000.0), "half_length_m <= 1000"),
    "a number of 400 digits": (lambda d: d.update(half_length_m=10**400), "half_length_m .* a huge number"),
    "steeper than 45 degrees": (lambda d: d.update(slope=3.0), "slope must be in"),
    "lane on the kerb": (lambda d: d.update(lane_offset_m=9.0), "lane_offset_m < kerb_m"),
    "missing name": (lambda d: d["objects"][1].pop("name"), r"object 1 .*missing name"),
    "name is a number": (lambda d: d["objects"][1].update(name=3), r"object 1 \('3'\), name must be a text"),
    "unknown state": (lambda d: d["objects"][1].update(states=["meanwhile"]), r"object 1 \('stays'\).*meanwhile"),
    "state twice": (lambda d: d["objects"][4].update(states=["after", "after"]), r"object 4 .*twice"),
    "states are text": (lambda d: d["objects"][1].update(states="before"), r"object 1 .*states must be a list"),
    "state is a list": (lambda d: d["objects"][1].update(states=[["before"]]), r"object 1 .*states must be some of"),
    "unknown edit": (lambda d: d["objects"][1].update(edit="painted"), r"object 1 .*painted"),
    "added, but in both states": (lambda d: d["objects"][1].update(edit="added"), r"object 1 .*is added, but stands"),
    "kept, but in one state": (lambda d: d["objects"][4].update(edit="kept"), r"object 4 .*is kept, but stands"),
    "moved from nowhere": (lambda d: d["objects"].pop(2), "'moves' is moved, but stands in one state only"),
    "twice the same name": (lambda d: d["objects"].append(d["objects"][1]), "not unique in state 'before': stays"),
    "no shapes": (lambda d: d["objects"][1].update(shapes=[]), r"object 1 .*no shapes"),
    "shapes are null": (lambda d: d["objects"][1].update(shapes=None), r"object 1 .*shapes must be a list"),
    "shape is text": (lambda d: d["objects"][1].update(shapes=["box"]), r"object 1 .*shape 0 must be a JSON object"),
    "unknown shape": (lambda d: shape_of(d).update(type="torus"), r"object 1 \('stays'\), shape 0.*'torus'"),
    "shape without type": (lambda d: shape_of(d).pop("type"), r"object 1 .*shape 0: unknown shape type 'None'"),
    "shape type is a list": (lambda d: shape_of(d).update(type=["block"]), r"object 1 .*unknown shape type"),
    "negative size": (lambda d: shape_of(d).update(half_x_m=-1.0), r"object 1 .*shape 0: .*half_x_m must be positive"),
    "text for a number": (lambda d: shape_of(d).update(half_x_m="wide"), r"shape 0, half_x_m must be a number"),
    "not a number": (lambda d: shape_of(d).update(half_x_m=float("nan")), r"shape 0, half_x_m must be a number"),
    "infinite": (lambda d: shape_of(d).update(x_m=float("inf")), r"shape 0, x_m must be a number .* got inf"),
    "far away": (lambda d: shape_of(d).update(x_m=9e5), "object 'stays' reaches .* beyond the street"),
    "as large as a country": (lambda d: shape_of(d).update(half_y_m=9e5), "object 'stays' reaches .* beyond"),
    "mirror": (lambda d: shape_of(d).update(reflectivity=7.0), r"shape 0: .*reflectivity"),
    "unknown key of a shape": (lambda d: shape_of(d).update(colour="red"), r"object 1 .*shape 0: unknown colour"),
    "missing key of a shape": (lambda d: shape_of(d).pop("top_m"), r"object 1 .*shape 0: missing top_m"),
}


@pytest.mark.parametrize("change", BREAK)
def test_a_corrupt_world_file_is_refused_by_name_and_place(change: str, tmp_path: Path) -> None:
    data = json.loads(TEXT)
    damage, message = BREAK[change]
    damage(data)
    path = tmp_path / "world.json"
    path.write_text(json.dumps(data), encoding="utf-8")
    with pytest.raises(WorldError, match=rf"world file .*world\.json.*{message}"):
        read_world(path)


@given(st.integers(0, len(TEXT) - 3))
def test_a_truncated_world_file_is_refused(length: int) -> None:
    with pytest.raises(WorldError, match="is not JSON"):
        from_json(TEXT[:length])


def test_nesting_that_no_parser_can_follow_is_refused() -> None:
    with pytest.raises(WorldError, match="nested too deeply"):
        from_json('{"format": ' + "[" * 200_000)


ANYTHING = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.just(10**400),
    st.lists(st.integers(), max_size=2), st.dictionaries(st.text(max_size=3), st.integers(), max_size=2),
)  # fmt: skip


def places(value: object, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Where in a JSON value something stands, as keys and positions."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [at, *(place for key, item in inner for place in places(item, (*at, key)))]


PLACES = places(json.loads(TEXT))[1:]


@given(place=st.sampled_from(PLACES), value=ANYTHING)
def test_anything_in_any_place_is_a_world_or_a_named_error(place: tuple[Any, ...], value: object) -> None:
    data = inner = deepcopy(json.loads(TEXT))
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    read, complaint = None, "world"
    try:
        read = from_json(json.dumps(data))
    except WorldError as error:
        complaint = str(error)
    assert complaint.startswith("world")
    assert read is None or from_json(to_json(read)) == read


def test_the_undamaged_text_is_the_world() -> None:
    assert from_json(TEXT) == SMALL
