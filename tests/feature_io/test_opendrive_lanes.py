"""Lanes of OpenDRIVE: direction, borders and successors, however the file says them; lamps, crosswalks, stop lines."""

import numpy as np
import pytest
from small_maps import put, write
from test_opendrive_import import in_file, read, road, xodr

from gnd.tile_store.feature_io.errors import DuplicateId, FeatureFileError, MissingReference
from gnd.tile_store.feature_io.formats import export_features, read_features
from gnd.tile_store.feature_io.lane_network import Border, MapLane, check_lanes, lane_of, neighbours
from gnd.tile_store.feature_io.lanelet2_lanes import line_tags
from gnd.tile_store.feature_io.values import FeatureFile, ImportOptions
from gnd.tile_store.sqlite_store import SqliteStore

WIDTH = '<width sOffset="0" a="3.5" b="0" c="0" d="0"/>'


def lane(id_: int, before: str = "", after: str = "", **attributes: str) -> str:
    """A lane; `before` and `after` are the ids of the lanes at its start and its end."""
    links = "".join(
        f'<{name} id="{one}"/>'
        for name, said in (("predecessor", before), ("successor", after))
        for one in said.split()
    )
    told = {"type": "driving"} | attributes
    return f'<lane id="{id_}" {" ".join(f"{k}={v!r}" for k, v in told.items())}><link>{links}</link>{WIDTH}</lane>'


def section(s: float, left: str = "", right: str = "") -> str:
    centre = '<center><lane id="0" type="none"/></center>'
    return f'<laneSection s="{s}"><left>{left}</left>{centre}<right>{right}</right></laneSection>'


def link(before: str = "", after: str = "") -> str:
    """ "road 2 start" or "junction 7" at the start and at the end of a road."""
    told = ""
    for name, said in (("predecessor", before), ("successor", after)):
        if said:
            kind, id_, *contact = said.split()
            point = f' contactPoint="{contact[0]}"' if contact else ""
            told += f'<{name} elementType="{kind}" elementId="{id_}"{point}/>'
    return f"<link>{told}</link>"


def at(x: float, length: float = 100.0) -> str:
    return f'<geometry s="0" x="{x}" y="0" hdg="0" length="{length}"><line/></geometry>'


def successors(found: FeatureFile) -> dict[str, set[str]]:
    return {one.key: set(one.successors) for one in found.lanes}


TWO_SECTIONS = section(0, lane(1, after="1"), lane(-1, after="-1")) + section(
    60, lane(1, before="1"), lane(-1, before="-1") + lane(-2)
)


def test_lanes_run_with_the_traffic_through_sections() -> None:
    found = read(xodr(road("", lanes=TWO_SECTIONS)))
    assert successors(found) == {
        "1/0/-1": {"1/1/-1"}, "1/1/-1": set(), "1/1/-2": set(), "1/1/1": {"1/0/1"}, "1/0/1": set()
    }  # fmt: skip
    by_key, name = (
        {one.key: one for one in found.lanes},
        {one.feature_id: dict(one.attributes) for one in found.features},
    )
    for key, left, right, ahead in (
        ("1/0/-1", "0", "-1", True),
        ("1/0/1", "0", "1", False),
        ("1/1/-2", "-1", "-2", True),
    ):
        borders = by_key[key].left, by_key[key].right
        assert [name[border.feature_id]["lane"] for border in borders] == [left, right]
        assert [border.ahead for border in borders] == [ahead, ahead]
    left, right = neighbours(found.lanes)
    assert (left, right) == ({"1/1/-2": "1/1/-1"}, {"1/1/-1": "1/1/-2"})


def test_where_traffic_keeps_left_lanes_run_the_other_way() -> None:
    found = read(xodr(road("", lanes=TWO_SECTIONS).replace("<road ", '<road rule="LHT" ')))
    assert successors(found)["1/1/-1"] == {"1/0/-1"}
    assert successors(found)["1/0/1"] == {"1/1/1"}
    left, _ = neighbours(found.lanes)
    assert left == {"1/1/-1": "1/1/-2"}


def test_a_reversed_lane_is_driven_against_its_side() -> None:
    found = read(xodr(road("", lanes=section(0, right=lane(-1) + lane(-2, direction="reversed")))))
    first, second = found.lanes
    assert (first.left.ahead, second.left.ahead) == (True, False)
    assert neighbours(found.lanes) == ({}, {})


def test_one_side_that_says_a_link_is_enough() -> None:
    """Road 1 says nothing of road 2, which lies behind it and is drawn in the other direction."""
    back = '<geometry s="0" x="200" y="0" hdg="3.141592653589793" length="100"><line/></geometry>'
    second = road(link(after="road 1 end"), back, section(0, lane(1, after="-1"), lane(-1, after="1")), id_="2")
    found = read(xodr(road("", at(0), section(0, lane(1), lane(-1))), second))
    assert successors(found) == {"1/0/-1": {"2/0/1"}, "2/0/-1": {"1/0/1"}, "1/0/1": set(), "2/0/1": set()}


def junction(*connections: str) -> bytes:
    """Road 1 into junction 7, whose road 3 goes on into road 2; the lanes say nothing of each other."""
    first = road(link(after="junction 7"), at(0), section(0, right=lane(-1) + lane(-2)))
    second = road(link(before="junction 7"), at(120), section(0, right=lane(-1) + lane(-2)), id_="2")
    inner = link("road 1 end", "road 2 start")
    across = road(inner, at(100, 20), section(0, right=lane(-1, after="-2")), length=20.0, id_="3")
    told = "".join(connections)
    return xodr(first, second, across).replace(
        b"</OpenDRIVE>", f'<junction id="7">{told}</junction></OpenDRIVE>'.encode()
    )


def test_a_junction_says_who_follows() -> None:
    start = '<connection incomingRoad="1" connectingRoad="3" contactPoint="start">'
    connection = start + '<laneLink from="-2" to="-1"/></connection>'
    found = successors(read(junction(connection)))
    assert found == {"1/0/-1": set(), "1/0/-2": {"3/0/-1"}, "3/0/-1": {"2/0/-2"}, "2/0/-1": set(), "2/0/-2": set()}
    assert successors(read(junction()))["1/0/-2"] == set()
    odd = (
        connection.replace('"3"', '"99"'),
        connection.replace('"-2"', '"?"'),
        connection.replace('"start"', '"middle"'),
    )
    assert successors(read(junction(*odd)))["1/0/-2"] == set()


def test_ends_that_both_lanes_leave_are_no_successor() -> None:
    """A link between lanes that are driven towards each other."""
    found = read(xodr(road("", lanes=section(0, right=lane(-1, after="1")) + section(50, left=lane(1, before="-1")))))
    assert successors(found) == {"1/0/-1": set(), "1/1/1": set()}


def test_what_a_lanelet_is_told() -> None:
    speed = '<speed sOffset="0" max="50" unit="km/h"/>'
    lanes = section(0, right=lane(-1).replace(WIDTH, WIDTH + speed) + lane(-2, type="biking") + lane(-3, type="median"))
    kind = '<type s="0" type="town"><speed max="13.5" unit="m/s"/></type>'
    first, second = read(xodr(road(kind, lanes=lanes))).lanes
    assert dict(first.tags) == {
        "location": "urban", "one_way": "yes", "source_lane": "1/0/-1", "speed_limit": "50 km/h", "subtype": "road"
    }  # fmt: skip
    assert (dict(second.tags)["subtype"], dict(second.tags)["speed_limit"]) == ("bicycle_lane", "13.5 m/s")


@pytest.mark.parametrize(
    ("mark", "tags"),
    [
        ("broken", {"type": "line_thin", "subtype": "dashed"}),
        ("solid solid", {"type": "line_thin", "subtype": "solid_solid"}),
        ("solid broken", {"type": "line_thin", "subtype": "solid_dashed"}),
        ("none", {"type": "virtual"}),
        ("curb", {"type": "curbstone", "subtype": "high"}),
        ("DASHED_WHITE", {"type": "line_thin", "subtype": "dashed", "color": "white"}),
        ("DOUBLE_SOLID_YELLOW", {"type": "line_thin", "subtype": "solid_solid", "color": "yellow"}),
        ("SOLID_DASH_WHITE SOLID_WHITE", {"type": "line_thin", "subtype": "solid_dashed", "color": "white"}),
        ("UNKNOWN", {"type": "unknown"}),
    ],
)
def test_marks_become_types_of_lanelet2(mark: str, tags: dict[str, str]) -> None:
    assert line_tags({"mark": mark}) == tags | {"mark": mark}


def test_stripes_are_told_from_left_to_right() -> None:
    """OpenDRIVE tells them from the inside of the road to its outside."""
    marked = WIDTH + '<roadMark sOffset="0" type="solid broken"/>'
    lanes = section(0, lane(1), lane(-1)).replace(WIDTH, marked)
    found = read(xodr(road("", lanes=lanes)))
    marks = {dict(one.attributes)["lane"]: dict(one.attributes)["mark"] for one in found.features}
    assert marks == {"1": "broken solid", "0": "none", "-1": "solid broken"}


FURNITURE = """<objects>
<object id="1" type="pole" name="streetLamp" s="5" t="-5"/>
<object id="2" type="pole" name="Street Light 04" s="6" t="-5"/>
<object id="3" type="pole" name="lamp_post" s="7" t="-5"/>
<object id="4" type="pole" name="traffic_light_pole" s="8" t="-5"/>
<object id="10" type="pole" name="PoleLamp" s="9" t="-5"/>
<object id="11" type="none" name="Straßenlaterne" s="10" t="-5"/>
<object id="12" type="pole" name="SignalLight" s="11" t="-5"/>
<object id="5" type="none" name="Crosswalk" s="50" t="0" hdg="1.5707963267948966" length="7" width="3"/>
<object id="6" type="crosswalk" s="60" t="0"><outline><cornerLocal u="-2" v="-3"/><cornerLocal u="2" v="-3"/>
<cornerLocal u="2" v="3"/><cornerLocal u="-2" v="3"/></outline></object>
<object id="7" type="crosswalk" s="70" t="0"><outlines><outline><cornerRoad s="70" t="-3"/><cornerRoad s="74" t="-3"/>
<cornerRoad s="74" t="3"/></outline></outlines></object>
<object id="8" type="roadMark" subtype="stopLine" s="40" t="-1.75" length="0.4" width="3.5"/>
<object id="9" type="-1" name="StopLine12" s="42" t="-1.75"/>
</objects><signals>
<signal id="20" s="30" t="-1.75" dynamic="no" type="294" country="DE"><validity fromLane="-2" toLane="-1"/></signal>
<signal id="21" s="32" t="-1.75" dynamic="no" type="294" country="OpenDRIVE" width="3"/>
<signal id="22" s="34" t="1.75" dynamic="no" type="294" orientation="-"/>
<signal id="23" s="36" t="-1.75" dynamic="no" type="294" country="US"/>
</signals>"""


def test_lamps_crosswalks_and_stop_lines_however_they_are_written() -> None:
    lanes = section(0, lane(1), lane(-1) + lane(-2))
    found = read(xodr(road(FURNITURE, lanes=lanes)))
    kinds = {one.name.split(", ")[-1]: one.kind for one in found.features if "lane" not in one.name.split(", ")[-1]}
    assert kinds == {
        "object 1": "streetlight", "object 2": "streetlight", "object 3": "streetlight", "object 4": "pole",
        "object 5": "crosswalk", "object 6": "crosswalk", "object 7": "crosswalk", "object 8": "stop_line",
        "object 9": "stop_line", "object 10": "streetlight", "object 11": "streetlight", "object 12": "pole",
        "signal 20": "stop_line", "signal 21": "stop_line", "signal 22": "stop_line",
        "signal 23": "traffic_sign",
    }  # fmt: skip
    assert found.left_out == {}

    def ends(**told: str) -> list[list[float]]:
        return np.round(in_file(found, told.pop("kind"), **told)[:, :2], 6).tolist()

    assert ends(kind="crosswalk", name="Crosswalk") == [
        [51.5, -3.5],
        [51.5, 3.5],
        [48.5, 3.5],
        [48.5, -3.5],
        [51.5, -3.5],
    ]
    assert sorted(ends(kind="stop_line", subtype="stopLine")) == [[40, -3.5], [40, 0]]
    assert ends(kind="stop_line", name="StopLine12") == [[42, -1.75]]
    assert ends(kind="stop_line", country="DE") == [[30, -7], [30, 0]]
    assert ends(kind="stop_line", country="OpenDRIVE") == [[32, -3.25], [32, -0.25]]
    assert ends(kind="stop_line", orientation="-") == [[34, 0], [34, 3.5]]
    outlines = [len(one) for one in found.features if one.kind == "crosswalk"]
    assert outlines == [5, 5, 4]


def test_a_new_lanelet2_file_is_read_back_with_the_same_kinds(store: SqliteStore, tmp_path) -> None:  # type: ignore[no-untyped-def]
    """Also signals, whose own `type` is a number that would hide what they are."""
    data = xodr(road(FURNITURE, lanes=section(0, lane(1), lane(-1) + lane(-2))))
    put(store, write(tmp_path, "r.xodr", data))
    assert export_features(store, tmp_path / "new.osm").changes is not None
    back = read_features(tmp_path / "new.osm", "new.osm", ImportOptions())
    was = read(data)
    counts = [sorted(one.kind for one in file.features) for file in (was, back)]
    assert counts[0] == counts[1]
    assert (len(back.lanes), back.kept) == (3, {"lanelet": 3})


def test_a_section_without_a_centre_lane_has_one() -> None:
    lanes = section(0, lane(1), lane(-1)).replace('<center><lane id="0" type="none"/></center>', "")
    found = read(xodr(road("", lanes=lanes)))
    assert (found.layers, len(found.lanes)) == ({"lanes": 3}, 2)


def test_a_stop_line_for_more_lanes_than_there_are_ends_at_the_last() -> None:
    signal = '<signal id="1" s="30" t="-2" type="294"><validity fromLane="-9" toLane="-1"/></signal>'
    found = read(xodr(road(f"<signals>{signal}</signals>", lanes=section(0, lane(1), lane(-1)))))
    np.testing.assert_allclose(in_file(found, "stop_line")[:, :2], [[30, -3.5], [30, 0]], atol=1e-6)


def test_lanes_that_name_what_is_not_there_are_refused() -> None:
    one = MapLane("a", Border(1, True), Border(2, True), (), ())
    check_lanes([one], [1, 2])
    with pytest.raises(MissingReference, match="lane a: its border 2 is no feature"):
        check_lanes([one], [1])
    with pytest.raises(DuplicateId, match="lane a comes 2 times"):
        check_lanes([one, one], [1, 2])
    with pytest.raises(MissingReference, match="1 of its successors are no lanes, first b"):
        check_lanes([MapLane("a", one.left, one.right, ("b",), ())], [1, 2])
    assert lane_of(one.as_list()) == one
    with pytest.raises(FeatureFileError, match="no lane"):
        lane_of(["a", [1, True]])


def test_without_borders_there_are_no_lanes() -> None:
    found = read(xodr(road("", lanes=TWO_SECTIONS)), layers={"lane_boundary": "-"})
    assert (found.lanes, found.features) == ((), ())
