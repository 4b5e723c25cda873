"""The account of feature layers of a run: a store with the map before, and what one vehicle said."""

from pathlib import Path

import numpy as np
import pytest

from gnd.deploy.features import feature_lines, put_base_layers, score_layers, tiles_of_vehicles
from gnd.fleet_sim.feature_files import write_feature_layers
from gnd.fleet_sim.feature_truth import base_features, feature_truth
from gnd.fleet_sim.street import street
from gnd.fleet_sim.world import write_world
from gnd.gnd_map.features import hit, miss
from gnd.schemas.features import FeatureChange, FeatureReport, Found, Seen, split_features
from gnd.schemas.report_id import deterministic_report_id
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import ReportRow

WORLD = street(101)
TRUTH = feature_truth(WORLD)


@pytest.fixture
def store(tmp_path: Path) -> SqliteStore:
    write_world(WORLD, tmp_path / "world.json")
    write_feature_layers(base_features(TRUTH), tmp_path / "features.json")
    SqliteStore(tmp_path / "store.sqlite").close()
    put_base_layers(tmp_path / "store.sqlite", tmp_path / "features.json", ("signs", "streetlights"))
    return SqliteStore(tmp_path / "store.sqlite")


def test_layers_of_the_map_before_are_put_and_others_begin_empty(store: SqliteStore) -> None:
    assert store.layers() == ["signs"]
    assert sum(len(tile.features) for tile in base_features(TRUTH)["signs"]) == sum(
        len(found.decode_features().features) for e in store.heads("signs") if (found := store.get("signs", e.tile))
    )


def test_a_map_that_nobody_touched_has_what_stayed_right_and_nothing_else(store: SqliteStore, tmp_path: Path) -> None:
    scores = score_layers(tmp_path / "world.json", store, ("signs", "streetlights"))
    signs = scores["signs"]
    assert signs["after"] == signs["before"]
    assert (signs["after"]["normal"], signs["after"]["deleted"], signs["after"]["new"]) == (100.0, 0.0, 0.0)
    assert signs["single"] == {}
    assert scores["streetlights"]["after"]["new"] == 0.0
    assert "layer signs" in feature_lines(scores)[0]


def test_what_one_vehicle_says_counts_for_it_alone(store: SqliteStore, tmp_path: Path) -> None:
    tile = base_features(TRUTH)["signs"][0]
    gone = tile.features[0]
    new = Found("traffic_sign", gone.points_m + np.array([2.0, 0.0, 0.0]), gone.cov_m2, hit(0.9), 7)
    change = FeatureChange(tile.tile_id, 1, tile.sha, 0, (Seen(gone.feature_id, miss(0.9)),), (new,))
    report_id = deterministic_report_id(1, "car")
    report = FeatureReport(report_id, "car", "camera", "test", "signs", tile.tile_id.district, 1, 2, (change,))
    rows = [ReportRow(report_id, "signs", t, "car", 3, body, base_sha=tile.sha) for t, body in split_features(report)]
    store.put_reports(rows)
    alone = {t.tile_id: t for t in tiles_of_vehicles(store, "signs", base_features(TRUTH)["signs"])["car"]}
    ids = {one.feature_id for one in alone[tile.tile_id].features}
    assert gone.feature_id not in ids
    assert len(ids) == len(tile.features)
    scores = score_layers(tmp_path / "world.json", store, ("signs",))["signs"]
    assert scores["single"]["normal"] <= 100.0
    assert scores["after"] == scores["before"]
