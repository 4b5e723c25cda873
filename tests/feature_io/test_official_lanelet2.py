"""Lanelets against the official library: read as it reads them, and written so that it routes over them."""

import json
from pathlib import Path

import numpy as np
import pytest
from small_maps import exported, put

official = pytest.importorskip("official", reason="the lanelet2 wheel cannot be installed on this platform")

from gnd.tile_store.feature_io.formats import export_features  # noqa: E402
from gnd.tile_store.feature_io.lane_network import neighbours  # noqa: E402
from gnd.tile_store.feature_io.placement import Placement  # noqa: E402
from gnd.tile_store.feature_io.stored import sources_of  # noqa: E402
from gnd.tile_store.feature_io.values import ImportOptions  # noqa: E402
from gnd.tile_store.sqlite_store import SqliteStore  # noqa: E402

MAPS = Path(__file__).parent / "maps"
ANCHOR = ImportOptions(placement=Placement.anchored(np.radians(35.9), np.radians(139.9), 0.0))
LATLON = ImportOptions(trust_latlon=True)
LANELET2 = {
    "hatched_road_marking.osm": (MAPS, ANCHOR, 3),
    "bus_stop_area.osm": (MAPS, LATLON, 2),
    "crosswalk_with_regulatory_element.osm": (MAPS, LATLON, 3),
    "lanelet2_route_1.osm": ("flexmap_georef", LATLON, 432),
    "mapping_example.osm": ("lanelet2_maps", LATLON, 371),
}


@pytest.mark.parametrize("name", LANELET2)
def test_as_many_lanelets_as_the_official_library_and_every_byte_back(
    name: str, shared_data: Path, store: SqliteStore, tmp_path: Path
) -> None:
    folder, options, count = LANELET2[name]
    file = (folder if isinstance(folder, Path) else shared_data / folder) / name
    if not file.exists():
        pytest.skip(f"real map not found: ../shared/data/{folder}/{name}")
    theirs = official.load(file, 49.0, 8.4)
    result = put(store, file, options)
    assert len(theirs.map.laneletLayer) == result.kept["lanelet"] == result.lanes["lanes"] == count
    assert exported(store, tmp_path / "back.osm") == file.read_bytes()
    if options is not LATLON:
        return  # the library puts nodes without lat and lon at 0, 0, where no lane has a direction
    ends = {str(one.id): _ends(one, -1) for one in theirs.map.laneletLayer}
    starts = {str(one.id): _ends(one, 0) for one in theirs.map.laneletLayer}
    for lane in sources_of(store)[name].lanes:
        assert set(lane.successors) == {key for key, start in starts.items() if start == ends[lane.key]}


def _ends(lanelet: object, which: int) -> tuple[int, int]:
    return lanelet.leftBound[which].id, lanelet.rightBound[which].id  # type: ignore[attr-defined]


@pytest.mark.parametrize("log", ["3bffdcff", "7fab2350"])
def test_all_lanes_of_argoverse_2_are_routable(log: str, shared_data: Path, store: SqliteStore, tmp_path: Path) -> None:
    folder = shared_data / "av2_pit_overlap" / log / "map"
    if not folder.is_dir():
        pytest.skip("real recording not found: ../shared/data/av2_pit_overlap")
    (file,) = folder.glob("log_map_archive_*.json")
    put(store, file)
    exported(store, tmp_path / "new.osm")
    theirs = official.load(tmp_path / "new.osm", 40.46, -79.95)
    expected = argoverse_says(json.loads(file.read_text()))
    assert theirs.errors == []
    assert len(theirs.lanelets) == len(expected) == {"3bffdcff": 211, "7fab2350": 183}[log]
    assert sum(len(one.successors) for one in expected.values()) == {"3bffdcff": 238, "7fab2350": 205}[log]
    assert official.not_routable(theirs, expected) == []
    assert {name for name in expected if not theirs.following(theirs.lanelets[name])} == {
        name for name, one in expected.items() if not one.successors
    }


def test_lanes_are_changed_over_dashes_and_not_over_solid_lines(
    shared_data: Path, store: SqliteStore, tmp_path: Path
) -> None:
    folder = shared_data / "av2_pit_overlap" / "3bffdcff" / "map"
    if not folder.is_dir():
        pytest.skip("real recording not found: ../shared/data/av2_pit_overlap")
    (file,) = folder.glob("log_map_archive_*.json")
    put(store, file)
    exported(store, tmp_path / "new.osm")
    theirs, told = official.load(tmp_path / "new.osm", 40.46, -79.95), json.loads(file.read_text())
    lanes, graph = told["lane_segments"], theirs.graphs["Vehicle"][1]
    changes = {"DASHED": 0, "SOLID": 0}
    for key, one in argoverse_says(told).items():
        vehicles = [one.left, key] if one.left and lanes[one.left]["lane_type"] == "VEHICLE" else []
        mark = lanes[key]["left_lane_mark_type"].partition("_")[0]
        if vehicles and lanes[key]["lane_type"] == "VEHICLE" and mark in changes:
            changes[mark] += 1
            assert (graph.left(theirs.lanelets[key]) is not None) == (mark == "DASHED")
            assert (graph.adjacentLeft(theirs.lanelets[key]) is not None) == (mark == "SOLID")
    assert min(changes.values()) > 0, changes


def argoverse_says(told: dict[str, dict[str, dict]]) -> dict[str, "official.Expected"]:  # type: ignore[type-arg]
    """By lane; neighbours in the other direction are none, nor are successors that the log's map does not hold."""
    lanes = told["lane_segments"]

    def beside(lane: dict, side: str) -> str | None:  # type: ignore[type-arg]
        other = lanes.get(str(lane[f"{side}_neighbor_id"]))
        inner = {"left": "right", "right": "left"}[side]
        same = other is not None and other[f"{inner}_lane_boundary"][0] == lane[f"{side}_lane_boundary"][0]
        return str(lane[f"{side}_neighbor_id"]) if same else None

    return {
        key: official.Expected(
            frozenset(str(one) for one in lane["successors"] if str(one) in lanes),
            beside(lane, "left"),
            beside(lane, "right"),
        )
        for key, lane in lanes.items()
    }


ORIGINS = {
    "San Francisco": (37.77, -122.42),
    "Tokyo": (35.68, 139.76),
    "Sydney": (-33.86, 151.2),
    "across 180 degrees": (-16.8, 180.0),
}


@pytest.mark.parametrize("place", ORIGINS)
def test_all_lanes_of_opendrive_are_routable_wherever_they_lie(place: str, store: SqliteStore, tmp_path: Path) -> None:
    """The town's own Lanelet2 file, which the tool that drew it wrote, has 26 lanelets for vehicles with 26 successors
    and 2 neighbours on their left."""
    lat, lon = ORIGINS[place]
    told = (MAPS / "town.xodr").read_text().replace("+lat_0=37.77 +lon_0=-122.42", f"+lat_0={lat} +lon_0={lon}")
    (tmp_path / "town.xodr").write_text(told)
    result = put(store, tmp_path / "town.xodr")
    assert (result.lanes["lanes"], result.notes) == (32, ())
    assert dict(result.features) == {"crosswalks": 4, "lanes": 54}
    exported(store, tmp_path / "new.osm")
    theirs = official.load(tmp_path / "new.osm", lat, lon)
    lanes = sources_of(store)["town.xodr"].lanes
    for_whom = {one.key: dict(one.tags)["subtype"] for one in lanes}
    left, right = (
        {key: other for key, other in side.items() if for_whom[key] == for_whom[other]} for side in neighbours(lanes)
    )
    expected = {
        one.key: official.Expected(frozenset(one.successors), left.get(one.key), right.get(one.key)) for one in lanes
    }
    assert theirs.errors == []
    assert official.not_routable(theirs, expected) == []
    rules, graph = theirs.graphs["Vehicle"]
    driven = [one for one in theirs.map.laneletLayer if rules.canPass(one)]
    assert len(driven) == 26
    assert sum(len(graph.following(one)) for one in driven) == 26
    assert sum(graph.left(one) is not None or graph.adjacentLeft(one) is not None for one in driven) == 2


@pytest.mark.parametrize(
    ("name", "lanes", "successors"), [("highway_exit", 13, 7), ("lane_sections", 15, 12), ("four_arms", 26, 28)]
)
def test_all_lanes_of_another_writer_are_routable(
    name: str, lanes: int, successors: int, store: SqliteStore, tmp_path: Path
) -> None:
    """Of the exit by hand: three lanes each way go on, and the rightmost one forks."""
    put(store, MAPS / f"{name}.xodr", ANCHOR)
    exported(store, tmp_path / "new.osm")
    theirs = official.load(tmp_path / "new.osm", 35.9, 139.9)
    left, right = neighbours(sources_of(store)[f"{name}.xodr"].lanes)
    expected = {
        one.key: official.Expected(frozenset(one.successors), left.get(one.key), right.get(one.key))
        for one in sources_of(store)[f"{name}.xodr"].lanes
    }
    assert (len(expected), sum(len(one.successors) for one in expected.values())) == (lanes, successors)
    assert theirs.errors == []
    assert official.not_routable(theirs, expected) == []
    graph = theirs.graphs["Vehicle"][1]
    assert sum(len(graph.following(one)) for one in theirs.map.laneletLayer) == successors


def test_a_lane_drawn_apart_from_its_successor_is_not_routable_and_said(store: SqliteStore, tmp_path: Path) -> None:
    """Road 5 lies 2 m higher in y than the road that it goes on from."""
    head, start, rest = (MAPS / "town.xodr").read_text().partition('<road id="5"')
    for y, higher in (("9.90997271378681460e-2", "2.099"), ("3.94645202137400730e-1", "2.395")):
        assert f'y="{y}"' in rest
        rest = rest.replace(f'y="{y}"', f'y="{higher}"', 1)
    told = head + start + rest
    (tmp_path / "town.xodr").write_text(told)
    put(store, tmp_path / "town.xodr")
    result = export_features(store, tmp_path / "new.osm")
    assert result.changes is not None
    assert (result.changes.lanelets, result.changes.apart) == (32, 2)
    theirs = official.load(tmp_path / "new.osm", 37.77, -122.42)
    expected = {
        one.key: official.Expected(frozenset(one.successors), None, None)
        for one in sources_of(store)["town.xodr"].lanes
    }
    assert len(official.not_routable(theirs, expected)) == 2
