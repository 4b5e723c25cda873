"""Imports are one transaction: all layers and what is kept of the file, or nothing; others' features stay."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_maps import STREET, STREET_IDS, put, write

from gnd.gnd_map.features import FeatureTile
from gnd.tile_store.feature_io import stored
from gnd.tile_store.feature_io.errors import BadGeometry, DuplicateId, FeatureFileError
from gnd.tile_store.feature_io.formats import export_features, read_features
from gnd.tile_store.feature_io.sources import FeatureSource
from gnd.tile_store.feature_io.stored import import_features, layer_tiles, load_features, sources_of
from gnd.tile_store.feature_io.values import FeatureFile, ImportOptions
from gnd.tile_store.sqlite_store import SqliteStore


def ids(store: SqliteStore) -> set[int]:
    return {one.feature_id for one in load_features(store)}


def test_an_import_says_what_it_did(store: SqliteStore, tmp_path: Path) -> None:
    file = write(tmp_path, "street.osm", STREET)
    first = put(store, file)
    assert (first.source, first.format, dict(first.features)) == ("street.osm", "lanelet2", STREET_IDS)
    assert (first.removed, first.unchanged, dict(first.left_out)) == (0, 0, {"untyped_way": 1})
    again = put(store, file)
    assert (again.tiles, again.unchanged) == (0, first.tiles)
    assert [line.kind for line in store.history("poles", store.heads("poles")[0].tile)] == ["base"]


def test_imported_again_a_file_replaces_itself(store: SqliteStore, tmp_path: Path) -> None:
    put(store, write(tmp_path, "street.osm", STREET))
    put(store, write(tmp_path, "other.osm", STREET))  # another source: other ids
    assert len(ids(store)) == 8
    without = STREET.replace(b'<tag k="type" v="pole"/>', b"")
    result = put(store, write(tmp_path, "street.osm", without))
    assert (result.removed, len(ids(store))) == (1, 7)
    assert sources_of(store)["street.osm"].document == without
    assert sources_of(store)["other.osm"].document == STREET
    elsewhere = put(store, tmp_path / "street.osm", ImportOptions({"traffic_sign": "plates"}))
    assert dict(elsewhere.features) == {"lanes": 2, "plates": 1}
    assert elsewhere.removed == 1  # it went from one layer to another
    assert {one.layer for one in load_features(store)} == {"lanes", "plates", "poles", "signs"}


def test_features_that_another_file_has_brought_are_not_taken_over(store: SqliteStore, tmp_path: Path) -> None:
    put(store, write(tmp_path, "street.osm", STREET))
    export_features(store, tmp_path / "copy.geojson")
    with pytest.raises(DuplicateId, match=r"4 of 4 features are in the store already, from street\.osm"):
        put(store, tmp_path / "copy.geojson")


def test_nothing_is_imported_when_one_layer_fails(store: SqliteStore, tmp_path: Path) -> None:
    file = read_features(write(tmp_path, "street.osm", STREET), "street.osm", ImportOptions())
    far = replace(file.features[-1], height_m=np.array([9_000.0]), cov_m2=np.full(6, np.nan))
    with pytest.raises(BadGeometry):
        import_features(store, FeatureFile("lanelet2", (*file.features[:-1], far), {}), "street.osm")
    assert (store.layers(), sources_of(store)) == ([], {})


def test_too_many_features_in_a_tile_are_counted(store: SqliteStore, tmp_path: Path) -> None:
    file = read_features(write(tmp_path, "street.osm", STREET), "street.osm", ImportOptions())
    pole = next(one for one in file.features if one.kind == "pole")
    crowd = tuple(replace(pole, feature_id=n + 1) for n in range(4097))
    with pytest.raises(BadGeometry, match=r"tile .* of layer poles: .*4097"):
        import_features(store, FeatureFile("lanelet2", crowd, {}), "crowd")
    assert store.layers() == []


def test_a_merge_in_between_is_not_overwritten(
    store: SqliteStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = write(tmp_path, "street.osm", STREET)
    put(store, file)
    moved = STREET.replace(b'lon="8.4007"', b'lon="8.4007001"')
    cut = stored.cut

    def slow_cut(*arguments):  # type: ignore[no-untyped-def]
        """Another process publishes the poles after the import has read them."""
        found = cut(*arguments)
        original = store.transact

        def late(work):  # type: ignore[no-untyped-def]
            for tile in layer_tiles(store, "poles"):
                put_ = [replace(one, hits=one.hits + 1) for one in tile.features]
                store.put_tiles([FeatureTile.of(tile.tile_id, 1, put_)], layer="poles")
            return original(work)

        monkeypatch.setattr(SqliteStore, "transact", lambda _self, work: late(work))
        return found

    monkeypatch.setattr(stored, "cut", slow_cut)
    with pytest.raises(FeatureFileError, match="went from version 1 to 2 during the import; nothing was imported"):
        put(store, write(tmp_path, "street.osm", moved))
    monkeypatch.undo()
    assert next(one for one in load_features(store, ["poles"])).hits == 1
    assert sources_of(store)["street.osm"].document == STREET


def test_features_are_found_by_layer_and_region(store: SqliteStore, tmp_path: Path) -> None:
    put(store, write(tmp_path, "street.osm", STREET))
    assert {one.kind for one in load_features(store, ["signs", "poles"])} == {"traffic_sign", "pole"}
    tile = store.heads("lanes")[1].tile  # in the middle of the borders
    found = load_features(store, region=tile.path)
    assert [len(one) for one in found if one.layer == "lanes"] == [2, 2]  # whole, not their pieces
    with pytest.raises(FeatureFileError, match="no feature layer 'lamps'; it has lanes, poles, signs"):
        load_features(store, ["lamps"])
    put(store, tmp_path / "street.osm", source="a")
    with pytest.raises(FeatureFileError, match=r"features come from a, street\.osm; say which"):
        export_features(store, tmp_path / "x.osm")
    with pytest.raises(FeatureFileError, match=r"no lanelet2 file 'c'; it has a, street\.osm"):
        export_features(store, tmp_path / "x.osm", source="c")
    with pytest.raises(FeatureFileError, match="all layers and regions are written"):
        export_features(store, tmp_path / "x.osm", ["lanes"], source="a")
    with pytest.raises(FeatureFileError, match="OpenDRIVE is written into the file"):
        export_features(store, tmp_path / "x.xodr")
    with pytest.raises(FeatureFileError, match=r"cannot write: No such file"):
        export_features(store, tmp_path / "none" / "x.geojson")


def test_a_backup_keeps_the_sources(store: SqliteStore, tmp_path: Path) -> None:
    put(store, write(tmp_path, "street.osm", STREET))
    store.backup(tmp_path / "copy.sqlite")
    with SqliteStore(tmp_path / "copy.sqlite", create=False) as copy:
        export_features(copy, tmp_path / "back.osm")
    assert (tmp_path / "back.osm").read_bytes() == STREET


def test_a_source_needs_a_name() -> None:
    with pytest.raises(FeatureFileError, match="1 … 200 characters, got 0"):
        FeatureSource("", "lanelet2", {}, {})
