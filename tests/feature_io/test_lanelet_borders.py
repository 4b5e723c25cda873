"""Borders of lanelets wherever on the Earth they lie: their crossings and their direction do not depend on it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from gnd.gnd_map.geodesy import LocalFrame
from gnd.tile_store.feature_io.lane_crossing import crossing_of
from gnd.tile_store.feature_io.lane_network import Border, MapLane
from gnd.tile_store.feature_io.lanelet2_borders import directions
from gnd.tile_store.feature_io.lanelet2_import import middle_of, read_lanelet2
from gnd.tile_store.feature_io.lanelet2_lanes import JOIN_M, joined_ends
from gnd.tile_store.feature_io.values import FeatureFile, ImportOptions

PLACES = [(37.77, -122.42), (35.68, 139.76), (-33.86, 151.2), (-16.8, 180.0), (64.1, -21.9), (0.0, 0.0)]


def osm(lines: list[np.ndarray], frame: LocalFrame, types: list[str] | None = None) -> bytes:
    """A file with the lines (N, 2) of a frame; the first two are the left and the right border of a lanelet."""
    nodes, ways = [], []
    for number, line in enumerate(lines):
        lat, lon, _ = frame.geodetic_from_enu(np.column_stack([line, np.zeros(len(line))]))
        ids = [1000 * (number + 1) + k for k in range(len(line))]
        for id_, *place in zip(ids, np.degrees(lat), np.degrees(lon), strict=True):
            nodes.append(f'<node id="{id_}" lat="{place[0]:.11f}" lon="{place[1]:.11f}"/>')
        refs = "".join(f'<nd ref="{id_}"/>' for id_ in ids)
        kind = types[number] if types else "line_thin"
        ways.append(f'<way id="{number + 1}">{refs}<tag k="type" v="{kind}"/></way>')
    lanelet = (
        '<relation id="9"><member type="way" ref="1" role="left"/><member type="way" ref="2" role="right"/>'
        '<tag k="type" v="lanelet"/></relation>'
    )
    return f'<osm version="0.6">{"".join(nodes)}{"".join(ways)}{lanelet}</osm>'.encode()


def read(data: bytes, **options: bool) -> FeatureFile:
    return read_lanelet2(data, "m.osm", "m", ImportOptions(**options))  # type: ignore[arg-type]


def lane(turn: float, width_m: float, bearing: float) -> list[np.ndarray]:
    """Left and right border of a lane of 60 m that turns by an angle in all."""
    s = np.linspace(0.0, 60.0, 25)
    heading = bearing + turn * s / 60.0
    middle = np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]), axis=0) * 2.5
    across = np.column_stack([-np.sin(heading), np.cos(heading)]) * width_m / 2
    return [middle + across, middle - across]


@settings(max_examples=150, deadline=None)
@given(
    st.floats(-85.0, 85.0), st.floats(-180.0, 180.0), st.floats(-1.5, 1.5), st.floats(0.02, 5.0), st.floats(0.0, 6.28),
    st.booleans(), st.booleans(),
)  # fmt: skip
def test_borders_side_by_side_never_cross_and_give_the_direction(
    lat: float, lon: float, turn: float, width_m: float, bearing: float, left_back: bool, right_back: bool
) -> None:
    frame = LocalFrame(np.radians(lat), np.radians(lon), 0.0)
    left, right = lane(turn, width_m, bearing)
    drawn = [left[::-1] if left_back else left, right[::-1] if right_back else right]
    found = read(osm(drawn, frame), strict=True)
    (one,) = found.lanes
    assert (one.left.ahead, one.right.ahead) == (not left_back, not right_back)


@settings(max_examples=60, deadline=None)
@given(st.floats(-85.0, 85.0), st.floats(-180.0, 180.0), st.floats(0.01, 1.0), st.floats(0.0, 6.28))
def test_borders_that_cross_by_a_centimetre_are_reported(lat: float, lon: float, deep_m: float, bearing: float) -> None:
    """The official library reads such a lanelet; so do we, and say it."""
    frame = LocalFrame(np.radians(lat), np.radians(lon), 0.0)
    left, right = lane(0.4, 3.0, bearing)
    left[12] = right[12] + (right[12] - left[12]) * deep_m / 3.0
    found = read(osm([left, right], frame))
    assert "the borders of lanelet 9 cross each other" in found.notes[0]
    assert len(found.lanes) == 1


@pytest.mark.parametrize("begins_m", [-1.0, 1.0])
@pytest.mark.parametrize(("lat", "lon"), PLACES)
def test_a_lane_that_narrows_does_not_cross_wherever_it_lies(lat: float, lon: float, begins_m: float) -> None:
    """To 0.3 m, with one border that begins a metre farther north or south than the other."""
    frame = LocalFrame(np.radians(lat), np.radians(lon), 0.0)
    left = np.column_stack([np.linspace(0.0, 2.7, 13), np.linspace(begins_m, 60.0, 13)])
    right = np.column_stack([np.full(13, 3.0), np.linspace(0.0, 60.0, 13)])
    found = read(osm([left, right], frame), strict=True)
    assert (found.notes, len(found.lanes)) == ((), 1)


def test_each_border_on_its_own_scale_would_cross_at_san_francisco() -> None:
    """The same lane with longitudes scaled by the cosine of each border's first latitude: why four lanelets of
    Lanelet2's example map were refused."""
    frame = LocalFrame(np.radians(37.77), np.radians(-122.42), 0.0)
    sides = []
    for line in (
        np.column_stack([np.linspace(0.0, 2.7, 13), np.linspace(1.0, 60.0, 13)]),
        np.column_stack([np.full(13, 3.0), np.linspace(0.0, 60.0, 13)]),
    ):
        lat, lon, _ = frame.geodetic_from_enu(np.column_stack([line, np.zeros(13)]))
        sides.append(np.column_stack([lon * np.cos(lat[:1]), lat]))
    assert crossing_of(*sides) is not None


def test_zig_zags_and_ways_without_a_type_are_counted() -> None:
    frame = LocalFrame(np.radians(49.0), np.radians(8.0), 0.0)
    lines = [*lane(0.0, 3.0, 0.0), np.array([[0.0, 9], [5, 9]]), np.array([[0.0, 12], [5, 12]])]
    data = osm(lines, frame, ["line_thin", "line_thin", "zig-zag", "Arrow"]).replace(b"</osm>", b"")
    data += b'<way id="5"><nd ref="1000"/><nd ref="1001"/></way></osm>'
    found = read(data)
    assert found.left_out == {"arrow": 1, "untyped_way": 1, "zig_zag": 1}
    assert found.kept == {"lanelet": 1}
    named = read_lanelet2(data, "m.osm", "m", ImportOptions(layers={"zig_zag": "markings"}))
    (marking,) = (one for one in named.features if one.layer == "markings")
    assert dict(marking.attributes)["type"] == "zig-zag"


def test_a_crossing_in_a_line_that_no_lane_uses_loses_nothing() -> None:
    frame = LocalFrame(np.radians(49.0), np.radians(8.0), 0.0)
    eight = np.array([[0.0, 9], [6, 12], [6, 9], [0, 12]])
    found = read(osm([*lane(0.0, 3.0, 0.0), eight], frame, ["line_thin", "line_thin", "curbstone"]))
    assert len(found.features) == 3
    assert len(found.notes) == 1
    assert "way 3 crosses itself" in found.notes[0]


def test_a_plate_across_180_degrees_hangs_in_its_middle() -> None:
    line = np.array([[0.1, np.pi - 1e-8, 5.0], [0.1, -np.pi + 3e-8, 7.0]])
    lat, lon, height = middle_of(line)
    assert (lat, height) == (0.1, 6.0)
    assert lon == pytest.approx(-np.pi + 1e-8, abs=1e-12)


def test_direction_of_a_turn_back() -> None:
    """A lane that turns by 180 degrees on the spot: its left border is short."""
    angle = np.linspace(0.0, np.pi, 15)
    left, right = (r * np.column_stack([np.sin(angle), 1 - np.cos(angle)]) for r in (1.0, 6.0))
    assert directions(left, right - [0, 5]) == (True, True)
    assert directions(left[::-1], right - [0, 5]) == (False, True)


@st.composite
def networks(draw: st.DrawFn) -> tuple[list[MapLane], dict[int, np.ndarray]]:
    """Lanes whose borders begin and end near the points of a lattice, and who follows whom, near or not."""
    n = draw(st.integers(1, 6))
    places = st.tuples(st.integers(0, 2), st.floats(-0.3, 0.3))
    lines, lanes = {}, []
    for lane_id in range(n):
        sides = []
        for side in (0, 1):
            ends = [draw(places) for _ in range(2)]
            m = np.array([[10.0 * at + off, 3.0 * side] for at, off in ends])
            lines[2 * lane_id + side] = np.column_stack([0.5 + m[:, 1] / 6.4e6, 0.2 + m[:, 0] / 5.6e6, np.zeros(2)])
            sides.append(Border(2 * lane_id + side, draw(st.booleans())))
        following = draw(st.lists(st.integers(0, n - 1), max_size=2, unique=True))
        lanes.append(MapLane(str(lane_id), sides[0], sides[1], tuple(map(str, following)), ()))
    return lanes, lines


@settings(max_examples=200, deadline=None)
@given(networks())
def test_ends_are_one_node_when_a_chain_of_near_successors_joins_them(
    network: tuple[list[MapLane], dict[int, np.ndarray]],
) -> None:
    """Against the connected components of scipy."""
    lanes, lines = network
    found = joined_ends(lanes, lines)
    number = {(line, which): 2 * k + (which == -1) for k, line in enumerate(lines) for which in (0, -1)}
    rows, apart = [], 0
    for lane in lanes:
        for key in lane.successors:
            pairs, far = [], 0.0
            for before, after in ((lane.left, lanes[int(key)].left), (lane.right, lanes[int(key)].right)):
                a = before.feature_id, -1 if before.ahead else 0
                b = after.feature_id, 0 if after.ahead else -1
                pairs.append((number[a], number[b]))
                frame = LocalFrame(*lines[a[0]][a[1]])
                far = max(far, float(np.linalg.norm(frame.enu_from_geodetic(*lines[b[0]][b[1]]).reshape(3)[:2])))
            rows += pairs if far <= JOIN_M else []
            apart += far > JOIN_M
    edges = np.array(rows or [(0, 0)]).T
    _, label = connected_components(coo_matrix((np.ones(edges.shape[1]), edges), (len(number), len(number))), False)
    assert (len(found.apart), found.joined) == (apart, len(rows) // 2)
    used = {k for pair in rows for k in pair}
    assert {number[end] for end in found.group} == used
    for one, a in found.group.items():
        for other, b in found.group.items():
            assert (a == b) == (label[number[one]] == label[number[other]])
