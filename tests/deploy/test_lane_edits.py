"""Edits of a Lanelet2 map from a layer of markings: right ones, none of what is as it was, and files that apply."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from gnd.deploy.cli import gnd
from gnd.deploy.lane_edits import lane_edits, map_pieces, painted
from gnd.fleet_sim.markings import paint_of
from gnd.fleet_sim.street import StreetOptions, street
from gnd.gnd_map.features import Feature, feature_id_of, prior
from gnd.gnd_map.features.lane_pieces import left_of
from gnd.gnd_map.geodesy import LocalFrame
from gnd.tile_store.feature_io.errors import FeatureFileError
from gnd.tile_store.feature_io.lanelet2_import import read_lanelet2
from gnd.tile_store.feature_io.osm_change import apply_osm_change
from gnd.tile_store.feature_io.values import ImportOptions
from gnd.tile_store.sqlite_store import SqliteStore
from studies.lanes_study.driving import SOURCE, hd_map

OPTIONS = ImportOptions(trust_latlon=True)


@pytest.fixture(scope="module")
def paint():
    return paint_of(street(7, StreetOptions(length_m=100.0, edit_share=0.0)))


@pytest.fixture(scope="module")
def hd(paint):
    return hd_map(paint)


def _layer(hd, change=None):
    """The map's own layer, with the pieces of one border (by its number) replaced by what `change` makes of each."""
    names = [one.feature_id for one in painted(hd.features)]
    layer = {}
    for tile, held in map_pieces(hd.features).items():
        some = []
        for one in held.features:
            number = names.index(int(dict(one.attributes)["border"]))
            made = one if change is None else change(number, one)
            some += [] if made is None else [made]
        layer[tile] = tuple(some)
    return layer


def _new(one, left=0.0, **tags):
    points = one.points_m + left * left_of(one.points_m)
    return Feature(
        feature_id_of("new", one.feature_id),
        "lane_marking",
        points,
        one.cov_m2,
        prior(0.9),
        tuple(sorted(tags.items())),
    )


def _applied(hd, found):
    after = apply_osm_change(hd.document, found.change.data)
    read = {one.feature_id: one for one in read_lanelet2(after, "after", SOURCE, OPTIONS).features}
    edited = {one.feature_id: one for one in read_lanelet2(found.edited, "edited", SOURCE, OPTIONS).features}
    assert read.keys() == edited.keys()
    assert all(np.array_equal(read[name].lat_rad, edited[name].lat_rad) for name in read)
    assert all(read[name].attributes == edited[name].attributes for name in read)
    return read


def test_a_map_that_is_right_has_no_edits(hd):
    found = lane_edits(hd, _layer(hd), SOURCE)
    assert found.edits == ()
    assert found.edited == hd.document
    assert sum(n for kinds in found.change.counts.values() for n in kinds.values()) == 0


def test_a_border_within_the_maps_own_error_has_no_edit(hd):
    off = _layer(hd, lambda k, one: _new(one, 0.15, subtype=dict(one.attributes)["subtype"]) if k == 4 else one)
    assert lane_edits(hd, off, SOURCE).edits == ()


@pytest.mark.parametrize("left", [0.3, -0.9])
def test_a_moved_border_is_moved(hd, left):
    layer = _layer(hd, lambda k, one: _new(one, left, subtype=dict(one.attributes)["subtype"]) if k == 4 else one)
    found = lane_edits(hd, layer, SOURCE)
    assert [edit.what for edit in found.edits] == ["moved"]
    assert abs(found.edits[0].shift_m) == pytest.approx(abs(left), abs=0.02)
    border = painted(hd.features)[4]
    moved = _applied(hd, found)[border.feature_id]
    frame = LocalFrame(float(border.lat_rad[0]), float(border.lon_rad[0]), float(border.height_m[0]))
    before, now = border.enu_m(frame)[:, :2], moved.enu_m(frame)[:, :2]
    t = (before[-1] - before[0]) / np.hypot(*(before[-1] - before[0]))
    away = (now - before[0]) @ np.array([-t[1], t[0]])
    assert away[len(now) // 2] == pytest.approx(found.edits[0].shift_m, abs=0.03)
    assert found.change.counts["delete"] == {"node": 0, "way": 0, "relation": 0}


def test_a_border_that_is_gone_stays_virtual_where_a_lanelet_needs_it(hd):
    found = lane_edits(hd, _layer(hd, lambda k, one: None if k == 4 else one), SOURCE)
    assert [edit.what for edit in found.edits] == ["virtual"]
    tags = dict(_applied(hd, found)[painted(hd.features)[4].feature_id].attributes)
    assert tags == {"type": "virtual"}


def test_a_border_that_no_lanelet_needs_goes(hd):
    from dataclasses import replace

    document = hd.document
    for _ in range(document.count(b"<relation")):
        start = document.index(b"<relation")
        document = document[:start] + document[document.index(b"</relation>", start) + 11 :]
    alone = replace(read_lanelet2(document, "hd.osm", SOURCE, OPTIONS), lanes=())
    found = lane_edits(alone, _layer(alone, lambda k, one: None if k == 4 else one), SOURCE)
    assert [edit.what for edit in found.edits] == ["removed"]
    assert painted(alone.features)[4].feature_id not in _applied(alone, found)
    assert found.change.counts["delete"]["way"] == 1


def test_another_type_is_told_by_its_tag(hd):
    other = {"solid": "dashed", "dashed": "solid"}
    layer = _layer(
        hd, lambda k, one: _new(one, 0.02, subtype=other[dict(one.attributes)["subtype"]]) if k == 4 else one
    )
    found = lane_edits(hd, layer, SOURCE)
    assert [edit.what for edit in found.edits] == ["retyped"]
    tags = dict(_applied(hd, found)[painted(hd.features)[4].feature_id].attributes)
    assert tags["subtype"] == found.edits[0].subtype


def test_yellow_paint_beside_white_is_added_and_white_is_unclear(hd):
    for color, what in (("yellow", "added"), ("white", "unclear")):
        layer = dict(_layer(hd))
        for tile, some in layer.items():
            mine = [one for one in some if int(dict(one.attributes)["border"]) == painted(hd.features)[4].feature_id]
            layer[tile] = (*some, *(_new(one, 0.8, subtype="solid", color=color) for one in mine))
        found = lane_edits(hd, layer, SOURCE)
        assert [edit.what for edit in found.edits] == [what]
        assert len(_applied(hd, found)) == len(hd.features) + (what == "added")


def test_a_border_that_is_gone_for_a_part_is_told_and_not_written(hd):
    own = [
        one.feature_id
        for held in map_pieces(hd.features).values()
        for one in held.features
        if int(dict(one.attributes)["border"]) == painted(hd.features)[4].feature_id
    ]
    assert len(own) >= 6
    layer = _layer(hd, lambda k, one: None if one.feature_id in own[: len(own) // 2] else one)
    found = lane_edits(hd, layer, SOURCE)
    assert {edit.what for edit in found.edits} <= {"partly_removed"}
    assert found.edited == hd.document


def test_the_official_library_reads_the_edited_map(hd, tmp_path):
    io = pytest.importorskip("lanelet2.io", reason="the lanelet2 wheel cannot be installed on this platform")
    from lanelet2 import projection

    layer = _layer(hd, lambda k, one: _new(one, 0.6, subtype=dict(one.attributes)["subtype"]) if k == 4 else one)
    found = lane_edits(hd, layer, SOURCE)
    (tmp_path / "after.osm").write_bytes(apply_osm_change(hd.document, found.change.data))
    first = painted(hd.features)[0]
    origin = io.Origin(float(np.degrees(first.lat_rad[0])), float(np.degrees(first.lon_rad[0])))
    read, errors = io.loadRobust(str(tmp_path / "after.osm"), projection.UtmProjector(origin))
    assert list(errors) == []
    assert len(read.laneletLayer) == len(hd.lanes)


def test_the_commands_go_round(hd, tmp_path):
    (tmp_path / "map.osm").write_bytes(hd.document)
    runner, map_file, store = CliRunner(), str(tmp_path / "map.osm"), str(tmp_path / "city.db")
    put = runner.invoke(gnd, ["lanes", "import", map_file, "--store", store, "--json"], catch_exceptions=False)
    assert json.loads(put.stdout)["pieces"] > 50
    with SqliteStore(tmp_path / "city.db", create=False) as opened:
        from gnd.tile_store.feature_io.stored import layer_tiles

        tiles = layer_tiles(opened, "markings")
        gone = dict(tiles[0].features[0].attributes)["border"]
        from gnd.gnd_map.features import FeatureTile

        left = [
            FeatureTile.of(one.tile_id, 2, [f for f in one.features if dict(f.attributes)["border"] != gone])
            for one in tiles
        ]
        opened.put_tiles(left, "base", "markings")
    out = str(tmp_path / "edits.osc")
    told = runner.invoke(
        gnd, ["lanes", "edits", map_file, "--store", store, "-o", out, "--json"], catch_exceptions=False
    )
    values = json.loads(told.stdout)
    assert values["counts"] == {"virtual": 1}
    assert str(values["edits"][0]["feature_id"]) != ""
    applied = runner.invoke(gnd, ["lanes", "apply", map_file, out, str(tmp_path / "new.osm")], catch_exceptions=False)
    assert applied.exit_code == 0
    assert b'v="virtual"' in (tmp_path / "new.osm").read_bytes()
    table = runner.invoke(gnd, ["lanes", "edits", map_file, "--store", store], catch_exceptions=False)
    assert "1 edits of" in table.stdout
    again = runner.invoke(gnd, ["lanes", "import", map_file, "--store", store])
    assert again.exit_code != 0


def test_a_map_without_paint_is_refused(tmp_path):
    from gnd.deploy.lanes_cli import _map

    (tmp_path / "empty.osm").write_bytes(b'<?xml version="1.0"?>\n<osm version="0.6">\n</osm>\n')
    with pytest.raises(FeatureFileError, match="no painted borders"):
        _map(tmp_path / "empty.osm", None)
