"""`gnd features …` as its users call it."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from small_maps import STREET, write

from gnd.deploy.features_cli import features
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.geodesy import LocalFrame
from gnd.tile_store.sqlite_store import SqliteStore

LOCAL = """<osm version="0.6"><node id="1" lat="0" lon="0"><tag k="type" v="pole"/><tag k="local_x" v="10"/>
<tag k="local_y" v="20"/></node></osm>"""


def gnd_features(*arguments: object) -> str:
    result = CliRunner().invoke(features, list(map(str, arguments)), catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def as_json(*arguments: object) -> Any:
    return json.loads(gnd_features(*arguments, "--json"))


def refused(*arguments: object) -> str:
    with pytest.raises(GndError) as caught:
        gnd_features(*arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture
def at(tmp_path: Path) -> Path:
    """A store with the street."""
    gnd_features("import", write(tmp_path, "street.osm", STREET), "--store", tmp_path / "map.sqlite")
    return tmp_path / "map.sqlite"


def test_import_makes_a_store_and_says_what_it_did(tmp_path: Path) -> None:
    file = write(tmp_path, "street.osm", STREET)
    told = as_json("import", file, "-o", tmp_path / "a.sqlite", "--layer", "pole=posts", "--source", "city")
    assert told["features"] == {"lanes": 2, "posts": 1, "signs": 1}
    assert (told["source"], told["format"], told["removed"], told["unchanged"]) == ("city", "lanelet2", 0, 0)
    again = gnd_features("import", file, "-o", tmp_path / "a.sqlite", "--layer", "pole=-", "--source", "city")
    assert "1 pole" in again
    assert "1 published" in again
    assert as_json("list", tmp_path / "a.sqlite")["layers"] == {
        "lanes": {"lane_boundary": 2},
        "signs": {"traffic_sign": 1},
    }


def test_a_bad_file_leaves_no_store_behind(tmp_path: Path) -> None:
    file = write(tmp_path, "bad.osm", STREET.replace(b"lat='49.00005'", b"lat='499.00005'"))
    assert "node 5: latitude 499.000050 degrees is beyond 90" in refused("import", file, "-o", tmp_path / "a.sqlite")
    empty = write(tmp_path, "empty.osm", "<osm/>")
    assert "no features to import" in refused("import", empty, "-o", tmp_path / "a.sqlite")
    assert {one.name for one in tmp_path.iterdir()} == {"bad.osm", "empty.osm"}
    assert "the folder" in refused("import", write(tmp_path, "s.osm", STREET), "-o", tmp_path / "none" / "a.sqlite")


def test_list_and_show(at: Path) -> None:
    told = as_json("list", at)
    assert told["features"] == 4
    assert told["sources"] == {"street.osm": {"format": "lanelet2", "lanes": 2, "poles": 1, "signs": 1}}
    (pole,) = as_json("list", at, "--kind", "pole")["listed"]
    assert (pole["layer"], pole["state"], pole["vertices"]) == ("poles", "exist", 1)
    assert (pole["lat_deg"], pole["lon_deg"]) == pytest.approx((49.00006, 8.4007), abs=2e-8)
    assert len(as_json("list", at, "--limit", 1)["listed"]) == 1
    assert as_json("list", at, "--layer", "signs", "--layer", "lanes")["features"] == 3
    shown = gnd_features("list", at, "--limit", 2)
    assert "lane_boundary" in shown
    assert "2 of 4 shown (--limit)" in shown
    one = as_json("show", at, pole["id"])
    assert one["properties"]["attributes"] == {"height": '6 & "a half"', "type": "pole"}
    with SqliteStore(at, create=False) as store:
        assert one["tiles"] == [store.heads("poles")[0].tile.path]
    assert one["reports"] == []
    assert '6 & "a half"' in gnd_features("show", at, pole["id"])
    assert "no feature 5; gnd features list shows" in refused("show", at, 5)


def test_export(at: Path, tmp_path: Path) -> None:
    told = as_json("export", at, tmp_path / "back.osm")
    assert (told["source"], told["features"]) == ("street.osm", 4)
    assert set(told["changes"].values()) == {0}
    assert (tmp_path / "back.osm").read_bytes() == STREET
    assert "into street.osm: 0 nodes and lines moved" in gnd_features("export", at, tmp_path / "back.osm")
    part = as_json("export", at, tmp_path / "signs.geojson", "--layer", "signs")
    assert (part["features"], part["source"], part["format"]) == (1, None, "geojson")
    new = as_json("export", at, tmp_path / "x", "--format", "lanelet2", "--layer", "lanes")
    assert (new["features"], new["source"]) == (2, None)
    assert "no features in signs" in refused(
        "export", at, tmp_path / "y.geojson", "--layer", "signs", "--region", "00000"
    )
    assert "its name tells no format" in refused("export", at, tmp_path / "y.txt")
    assert "no such store" in refused("export", tmp_path / "none.sqlite", tmp_path / "y.geojson")


def test_a_georeference_is_an_anchor_latlon_or_a_track(tmp_path: Path) -> None:
    file, at = write(tmp_path, "local.osm", LOCAL), tmp_path / "a.sqlite"
    assert "say --georeference latlon if they hold" in refused("import", file, "-o", at)
    gnd_features("import", file, "-o", at, "--georeference", "48,11,500,90", "--source", "turned")
    gnd_features("import", file, "-o", at, "--georeference", "latlon", "--source", "as it says")
    rows = {round(row["lat_deg"]): row for row in as_json("list", at)["listed"]}
    frame = LocalFrame(np.radians(48.0), np.radians(11.0), 500.0)
    place = frame.enu_from_geodetic(*np.radians([rows[48]["lat_deg"], rows[48]["lon_deg"]]), rows[48]["height_m"])
    np.testing.assert_allclose(place.reshape(3), [20.0, -10.0, 0.0], atol=1e-3)  # y is east, so x is south
    assert (rows[0]["lat_deg"], rows[0]["lon_deg"]) == pytest.approx((0.0, 0.0), abs=1e-8)
    for wrong in ("here", "48", "48,11,1,2,3", "95,0"):
        assert "is not latlon, track or LAT,LON" in refused("import", file, "-o", at, "--georeference", wrong)
    assert "needs --poses FILE and --fixes FILE" in refused("import", file, "-o", at, "--georeference", "track")
    assert "go with --georeference track" in refused("import", file, "-o", at, "--poses", file)
    by_track = ("--georeference", "track", "--poses", file, "--fixes", file)
    assert "no table of numbers" in refused("import", file, "-o", at, *by_track)
    assert "is not like traffic_light=signals" in refused("import", file, "-o", at, "--layer", "pole")


def test_the_command_tells_errors_in_one_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "gnd.deploy.cli", "features", "import", str(tmp_path / "no.osm"), "-o", "x"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"gnd: {tmp_path / 'no.osm'}: cannot be read: No such file or directory\n"


def test_what_crosses_is_printed_and_strictly_refused(tmp_path: Path) -> None:
    """The street with the ends of its right border exchanged in latitude: it crosses the left one."""
    odd = STREET.replace(b"<node id='2' lat='49.0000000'", b"<node id='2' lat='49.0000600'")
    file = write(tmp_path, "odd.osm", odd)
    said = refused("import", file, "-o", tmp_path / "a.sqlite", "--strict")
    assert "the borders of lanelet 20 cross each other (segment 1 of 1 on the left, 1 of 1 on the right)" in said
    assert not (tmp_path / "a.sqlite").exists()
    shown = gnd_features("import", file, "-o", tmp_path / "a.sqlite")
    assert "the borders of lanelet 20 cross each other" in shown
    assert "1 lanelet, 1 nobody_knows, 1 regulatory_element" in shown
    gnd_features("export", tmp_path / "a.sqlite", tmp_path / "back.osm")
    assert (tmp_path / "back.osm").read_bytes() == odd


def test_a_lane_that_lost_its_border_is_left_out_and_said(tmp_path: Path) -> None:
    """A new file of the street's west end only, and one without the lanes."""
    at = tmp_path / "map.sqlite"
    gnd_features("import", write(tmp_path, "street.osm", STREET), "-o", at)
    whole = as_json("export", at, tmp_path / "new.osm", "--source", "")
    assert (whole["changes"]["lanelets"], whole["changes"]["unbounded"]) == (1, 0)
    without = as_json("export", at, tmp_path / "signs.osm", "--layer", "signs")
    assert (without["changes"]["lanelets"], without["changes"]["unbounded"]) == (0, 1)
