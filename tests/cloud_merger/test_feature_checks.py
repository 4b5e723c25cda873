"""Reports about features that cannot be true are refused, with numbers, and kept in quarantine."""

import dataclasses
import re

import numpy as np
import pytest
from feature_cloud import ABSENT, EAST, EXIST, TILE, change, feature, found, line, published, report, seen
from merger_world import GROUND, POLE, change_of, gaussians_of, report_of
from upload_desk import NOW, Desk

from gnd.cloud_merger.errors import BadReport
from gnd.cloud_merger.features.check import check_feature_report
from gnd.gnd_map.features import FeatureTile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import SchemaError
from gnd.schemas.feature_layer import LayerParameters
from gnd.schemas.features import FeatureReport
from gnd.schemas.keys import change_key
from gnd.tile_store.sqlite_store import SqliteStore

MAP = published([feature(n, -12.0 + 2.5 * n, 0.0) for n in range(1, 10)])
KEY = change_key("signs", TILE.district)
FAR = TileId(TILE.morton + (1 << 20))  # some 39 km away


def known(tile, sha):
    return {one.feature_id for one in MAP} if sha == FeatureTile.of(TILE, 1, MAP).sha and tile == TILE else None


def refusal(*changes, layer=None):
    with pytest.raises(BadReport) as caught:
        check_feature_report(report(1, *changes), known, layer)
    return str(caught.value)


def check(*changes):
    check_feature_report(report(1, *changes), known)


def with_cov(*cov):
    return dataclasses.replace(found(0.0, 0.0), cov_m2=np.array(cov, np.float64))


def test_a_good_report_passes():
    check(
        change(seen(1), seen(2, ABSENT), seen(3, EXIST, (-4.0, 0.0)), found(1.0, 1.0), line((0, 0), (5, 0)), base=MAP)
    )


def test_a_drive_that_finds_every_sign_gone_is_not_believed():
    every = [seen(one.feature_id, ABSENT) for one in MAP]
    assert "9 of 9 judged features are called deleted, the limit is 0.5 of 5" in refusal(change(*every, base=MAP))
    some = [seen(n, ABSENT if n < 5 else EXIST) for n in range(1, 10)]
    check(change(*some, base=MAP))
    check(change(*every[:4], base=MAP))  # too few to tell; one vehicle changes nothing anyway


@pytest.mark.parametrize(
    ("cov", "says"),
    [
        ((1e-8, 0, 0, 1.0, 0, 1.0), "0.0001 m in one direction, nobody measures better than 0.001 m"),
        ((1.0, 1.0, 0, 1.0, 0, 1.0), "nobody measures better"),
        ((2000.0, 0, 0, 1.0, 0, 1.0), "known to 44.7 m only, the limit is 30 m"),
        ((1.0, 0, 0, 1.0, 0, 5e4), "variance 5e\\+04 m² of its height"),
    ],
)
def test_absurd_covariances_are_refused(cov, says):
    with pytest.raises(BadReport, match=says):
        check(change(with_cov(*cov)))


def test_a_covariance_that_is_none_never_comes_so_far():
    with pytest.raises(SchemaError, match="eigenvalue"):
        with_cov(1.0, 2.0, 0, 1.0, 0, 1.0)


def test_unknown_heights_pass_as_they_travel():
    whole = report(1, change(found(0.0, 0.0, height_m2=1e4), found(3.0, 0.0, sigma_m=1e-3, height_m2=1e-6)))
    check_feature_report(FeatureReport.decode(whole.encode()), known)


def test_a_measurement_far_outside_the_tile_is_refused():
    assert "map feature 1 was measured" in refusal(change(seen(1, EXIST, (60.0, 0.0)), base=MAP))
    with pytest.raises(SchemaError, match="outside its tile"):
        change(found(60.0, 0.0))


def test_too_many_features_are_refused():
    many = [found(0.1 * n - 12.8, (n % 50) * 0.5 - 12) for n in range(257)]
    check(change(*many[:256]))
    assert "257 features found, 0 judged, the limit is 256" in refusal(change(*many))
    assert "513 vertices, the limit is 512" in refusal(change(line(*[(0.02 * n, 0.0) for n in range(513)])))


def test_a_declared_layer_takes_its_own_kinds_and_geometry_only():
    hydrants = LayerParameters("signs", "camera", ("hydrant",))
    check_feature_report(report(1, change(found(1.0, 1.0, kind="hydrant"))), known, hydrants)
    said = refusal(change(found(1.0, 1.0, kind="pole")), layer=hydrants)
    assert "found pole 0: layer signs is declared to hold hydrant" in said
    lines = dataclasses.replace(hydrants, kinds=("lane_boundary",), geometry="line")
    check_feature_report(report(1, change(line((0, 0), (5, 0)))), known, lines)
    assert "2 vertices, layer signs holds points" in refusal(
        change(line((0, 0), (5, 0))), layer=dataclasses.replace(lines, geometry="point")
    )


def test_the_same_thing_twice_in_a_report_is_refused():
    twice = refusal(change(found(1.0, 1.0), found(5.0, 1.0), found(1.05, 1.0)))
    assert "found traffic_sign 0 and 2 lie 0.050 m apart" in twice
    check(change(found(1.0, 1.0), found(1.05, 1.0, kind="pole")))
    check(change(found(1.0, 1.0, attributes=(("code", "274"),)), found(1.05, 1.0, attributes=(("code", "276"),))))
    check(change(found(1.0, 1.0, height_m=2.0, height_m2=0.01), found(1.0, 1.0, height_m=3.0, height_m2=0.01)))
    check(change(found(1.0, 1.0, sigma_m=0.01), found(1.09, 1.0, sigma_m=0.01)))


def test_lanes_that_cross_themselves_are_refused():
    with pytest.raises(SchemaError, match="crosses itself: segments 0 and 2"):
        line((0, 0), (10, 0), (10, 5), (5, -5))


def test_verdicts_on_what_the_version_has_not_are_refused():
    assert "judges feature 99, one of 1 that version 1 with its 9 features has not" in refusal(
        change(seen(99), base=MAP)
    )
    check(change(seen(1), base=MAP[:3]))  # a version that has gone: nobody knows what it had


# Through ingest, on a store


@pytest.fixture
def store(tmp_path):
    with SqliteStore(tmp_path / "map.sqlite") as store:
        store.put_tiles([FeatureTile.of(TILE, 1, MAP)], layer="signs")
        yield store


@pytest.fixture
def desk(store):
    return Desk(store)


def good(number=1, **names):
    return report(number, change(seen(1), found(1.0, 1.0), base=MAP), **names)


def test_a_good_report_is_kept_before_it_is_acknowledged(store, desk):
    ack = desk.ack(KEY, good().encode())
    assert (ack.report_id, ack.status) == (good().report_id, "stored")
    desk.work()
    assert desk.ack(KEY, good().encode()).status == "duplicate"
    (row,) = [row for row in store.reports("signs") if row.tile == TILE]
    assert (row.vehicle, row.received_ns, row.base_sha) == ("car-1", NOW, FeatureTile.of(TILE, 1, MAP).sha)
    assert FeatureReport.decode(row.body) == good().snapped()
    assert store.quarantined() == []


def test_what_lies_near_the_border_is_kept_for_the_neighbour_too(store, desk):
    near = report(1, change(found(15.0, 0.0, sigma_m=2.0), found(-5.0, 0.0, sigma_m=0.1), base=MAP))
    desk.send(KEY, near.encode())
    rows = {row.tile: FeatureReport.decode(row.body) for row in store.reports("signs")}
    assert EAST in rows
    (told,) = rows[EAST].tiles
    assert (told.tile, told.base_sha, told.viewed, len(told.found)) == (TILE, b"", 0, 1)
    assert len(rows[TILE].tiles[0].found) == 2


@pytest.mark.parametrize(
    ("made", "key", "says"),
    [
        (lambda: good(layer="lamps"), KEY, "report for lamps .* came on the key of signs"),
        (lambda: good(), change_key("signs", FAR.district), "came on the key of"),
        (lambda: report(1, change(found(0, 0), tile=FAR)), change_key("signs", FAR.district), "is not on the map"),
        (lambda: report(1, change(*(seen(n, ABSENT) for n in range(1, 10)), base=MAP)), KEY, "9 of 9 judged"),
    ],
)
def test_bad_reports_go_to_quarantine(store, desk, made, key, says):
    ack = desk.send(key, made().encode())
    assert ack.status == "quarantined"
    assert re.search(says, ack.reason)
    (kept,) = store.quarantined()
    assert kept.body == made().encode()
    assert list(store.reports("signs")) == []


def test_a_report_against_a_version_that_is_gone_is_welcome(store, desk):
    assert desk.send(KEY, report(1, change(seen(1), base=MAP[:2])).encode()).status == "released"
    assert {row.tile for row in store.reports("signs")} == {TILE}


def test_a_new_layer_begins_where_another_layer_has_a_map(store, desk):
    lamps = report(1, change(found(1.0, 1.0, kind="streetlight")), layer="streetlights")
    assert desk.send(change_key("streetlights", TILE.district), lamps.encode()).status == "released"


def test_gaussians_on_the_key_of_a_feature_layer_are_refused(store, desk):
    voxels = report_of(1, change_of(gaussians_of({0: GROUND}), [0, 2], {2: POLE}))
    ack = desk.send(KEY, voxels.encode())
    assert ack.status == "quarantined"
    assert "speaks of Gaussians, layer signs holds features" in ack.reason
