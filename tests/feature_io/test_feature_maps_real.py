"""Real maps: a Lanelet2 map and the drive along it (Garching), two Argoverse 2 maps that overlap (Pittsburgh)."""

import itertools
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from matplotlib.path import Path as Outline
from scipy.spatial import cKDTree
from test_feature_geojson import check_rfc7946

from gnd.deploy.features_cli import features
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.router import open_router
from gnd.gnd_map.content import codecs_of_layer
from gnd.gnd_map.features import FeatureTile
from gnd.gnd_map.geodesy import LocalFrame
from gnd.schemas import keys
from gnd.schemas.tiles import TileReply, TileRequest, features_of
from gnd.tile_store.feature_io.about import options_about
from gnd.tile_store.feature_io.lanelet2_export import write_lanelet2
from gnd.tile_store.feature_io.lanelet2_import import drawn_features
from gnd.tile_store.feature_io.osm_document import read_osm
from gnd.tile_store.feature_io.stored import feature_layers, load_features, sources_of
from gnd.tile_store.feature_io.values import MapFeature
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.localise.drawn_map import read_fixes, read_track

OSM, POSES, FIXES = "lanelet2_route_1.osm", "route1_pose_kitti.txt", "route_1_GPS.txt"
AV2 = ("3bffdcff", "7fab2350")


def gnd_features(*arguments: object) -> str:
    result = CliRunner().invoke(features, list(map(str, arguments)), catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def folder(shared_data: Path, name: str) -> Path:
    found = shared_data / name
    if not found.is_dir():
        pytest.skip(f"real recording not found: ../shared/data/{name}")
    return found


@pytest.fixture(scope="module")
def garching(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Lanelet2 map in a store, laid on the Earth by the GNSS of the drive over whose track it was drawn."""
    real, at = folder(shared_data, "flexmap_georef"), tmp_path_factory.mktemp("garching") / "map.sqlite"
    by_track = ("--georeference", "track", "--poses", real / POSES, "--fixes", real / FIXES)
    told = json.loads(gnd_features("import", real / OSM, "--store", at, *by_track, "--json"))
    assert told["features"] == {"lanes": 658, "signs": 1}
    assert told["left_out"] == {}
    return at


@pytest.fixture(scope="module")
def pittsburgh(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both Argoverse 2 maps in one store."""
    real, at = folder(shared_data, "av2_pit_overlap"), tmp_path_factory.mktemp("pittsburgh") / "map.sqlite"
    for log in AV2:
        (file,) = (real / log / "map").glob("log_map_archive_*.json")
        gnd_features("import", file, "--store", at, "--source", log)
    return at


@pytest.fixture(params=["garching", "pittsburgh"])
def real_store(request: pytest.FixtureRequest) -> Iterator[SqliteStore]:
    with SqliteStore(request.getfixturevalue(request.param), create=False) as opened:
        yield opened


def test_the_lanelet2_map_comes_back_byte_by_byte(garching: Path, shared_data: Path, tmp_path: Path) -> None:
    gnd_features("export", garching, tmp_path / "back.osm")
    assert (tmp_path / "back.osm").read_bytes() == (shared_data / "flexmap_georef" / OSM).read_bytes()


def test_its_geometry_written_anew_is_the_same_to_the_millimetre(garching: Path) -> None:
    with SqliteStore(garching, create=False) as store:
        kept = sources_of(store)[OSM]
        found = load_features(store)
    options = options_about(kept.options)
    data, changes = write_lanelet2(found, kept.document, OSM, options, keep_within_m=-1.0)
    assert changes.moved == 2162
    was, now = read_osm(kept.document, "was").nodes, read_osm(data, "now").nodes
    local = [
        np.array([[float(n.tags[k]) for k in ("local_x", "local_y", "ele")] for n in d.values()]) for d in (was, now)
    ]
    assert np.linalg.norm(local[0] - local[1], axis=1).max() < 1.2e-3  # the lattice is 1 mm: half of it on each axis
    degrees = [np.array([(n.lat_deg, n.lon_deg) for n in d.values()]) for d in (was, now)]
    assert np.abs(degrees[0] - degrees[1]).max() < 2e-8  # placeholders that move with the map: 2 mm
    assert len(data) == pytest.approx(len(kept.document), rel=0.02)


def lanelets(store: SqliteStore, frame: LocalFrame) -> list[np.ndarray]:
    """Outlines (N, 2) of the lanelets: borders from the store, which of them belong together from the file."""
    kept = sources_of(store)[OSM]
    document = read_osm(kept.document, OSM)
    by_id = {one.feature_id: one for one in load_features(store, ["lanes"])}
    border = {
        one.element.id: by_id[one.feature.feature_id].enu_m(frame)[:, :2]
        for one in drawn_features(document, OSM, options_about(kept.options))[0]
        if one.feature.kind == "lane_boundary"
    }
    outlines = []
    for relation in document.relations.values():
        if relation.tags["type"] == "lanelet":
            left, right = (border[relation.member("way", side)[0]] for side in ("left", "right"))
            ends = [np.linalg.norm(left[[0, -1]] - other[[0, -1]], axis=1).sum() for other in (right, right[::-1])]
            outlines.append(np.concatenate([left, (right if ends[0] <= ends[1] else right[::-1])[::-1]]))
    return outlines


def within(outlines: list[np.ndarray], p: np.ndarray) -> np.ndarray:
    inside = np.zeros(len(p), np.bool_)
    for outline in outlines:
        inside |= Outline(outline).contains_points(p)
    return inside


def test_the_drive_lies_in_the_lanes_of_its_map(garching: Path, shared_data: Path) -> None:
    real = shared_data / "flexmap_georef"
    with SqliteStore(garching, create=False) as store:
        placement = options_about(sources_of(store)[OSM].options).placement
        assert placement is not None
        outlines = lanelets(store, placement.frame)
    assert len(outlines) == 432
    track = np.ascontiguousarray(read_track(real / POSES).T_dst_vehicle[:, :3, 3])
    driven = placement.frame.enu_from_geodetic(*placement.geodetic(track))[:, :2]
    assert within(outlines, driven).all()  # all 1,208 poses
    fixes = read_fixes(real / FIXES)
    moving = fixes.moving()
    measured = placement.frame.enu_from_geodetic(fixes.lat_rad[moving], fixes.lon_rad[moving], 0.0)[:, :2]
    assert within(outlines, measured).mean() > 0.995  # 5,653 of 5,667 fixes: GNSS never saw the lanes


def test_two_maps_of_the_same_place_coincide(pittsburgh: Path) -> None:
    frame = LocalFrame(np.radians(40.4635), np.radians(-79.951), 0.0)
    with SqliteStore(pittsburgh, create=False) as store:
        found = load_features(store)
        ids = {log: {i for of in sources_of(store)[log].ids.values() for i in of} for log in AV2}
    same, pairs = {}, {}
    for kind in ("lane_boundary", "crosswalk", "drivable_area"):
        a, b = ([one for one in found if one.kind == kind and one.feature_id in ids[log]] for log in AV2)
        off_m = np.array(list(offsets_m(a, b, frame)))
        pairs[kind], same[kind] = len(off_m), int((off_m < 2e-3).sum())
        assert off_m.max() < 0.15
    assert pairs == {"lane_boundary": 127, "crosswalk": 5, "drivable_area": 5}
    assert same == {"lane_boundary": 121, "crosswalk": 5, "drivable_area": 5}


def offsets_m(a: list[MapFeature], b: list[MapFeature], frame: LocalFrame) -> Iterator[float]:
    """Of each line of `a` whose ends both lie within half a metre of those of a line of `b`: how far apart the two are
    at most, seen from above (heights come from each drive's own ground).
    """
    lines = [line for one in b for line in (one.enu_m(frame)[:, :2], one.enu_m(frame)[::-1, :2])]
    tree = cKDTree([np.concatenate([line[0], line[-1]]) for line in lines])
    for one in a:
        line = one.enu_m(frame)[:, :2]
        near, which = tree.query(np.concatenate([line[0], line[-1]]), k=6, distance_upper_bound=0.5)
        others = [lines[i] for i in which[np.isfinite(near)]]
        if others:
            equal = [float(np.abs(line - other).max()) for other in others if len(other) == len(line)]
            yield min(equal, default=np.inf)


def test_as_geojson_a_real_map_comes_back_the_same(real_store: SqliteStore, tmp_path: Path) -> None:
    gnd_features("export", real_store.path, tmp_path / "map.geojson")
    check_rfc7946(json.loads((tmp_path / "map.geojson").read_text("utf-8")))
    gnd_features("import", tmp_path / "map.geojson", "-o", tmp_path / "copy.sqlite")
    with SqliteStore(tmp_path / "copy.sqlite", create=False) as copy:
        assert copy.layers() == real_store.layers()
        for layer in copy.layers():
            assert [(e.tile, e.sha) for e in copy.heads(layer)] == [(e.tile, e.sha) for e in real_store.heads(layer)]


def test_a_real_map_is_served_over_a_router(real_store: SqliteStore, free_port: int) -> None:
    at = f"tcp/127.0.0.1:{free_port}"
    with (
        open_router((at,)),
        open_bus(BusConfig(connect=(at,)), name="store") as bus,
        TileServer(real_store, bus),
        open_bus(BusConfig(connect=(at,)), name="vehicle") as client,
    ):
        for layer in feature_layers(real_store):
            request = TileRequest(codecs=codecs_of_layer(layer)).encode()
            for entry in itertools.islice(real_store.heads(layer), 0, None, 7):  # every seventh tile
                answer = client.request(keys.tile_key(layer, entry.tile), request, kind="tile", timeout_s=20.0)
                blob = TileReply.decode(answer).blob
                stored = real_store.get(layer, entry.tile)
                assert blob is not None
                assert stored is not None
                tile = features_of(blob)
                assert isinstance(tile, FeatureTile)
                assert (tile.sha, tile.features) == (entry.sha, stored.decode_features().features)


def test_the_official_library_reads_what_we_write(garching: Path, tmp_path: Path) -> None:
    lanelet2 = pytest.importorskip("lanelet2", reason="the lanelet2 wheel is not installed")
    projection = pytest.importorskip("lanelet2.projection")
    io = pytest.importorskip("lanelet2.io")
    assert lanelet2 is not None
    with SqliteStore(garching, create=False) as store:
        found = load_features(store, ["lanes"])
    gnd_features("export", garching, tmp_path / "new.osm", "--source", "")
    frame = LocalFrame(np.radians(48.265), np.radians(11.67), 0.0)
    projector = projection.LocalCartesianProjector(io.Origin(48.265, 11.67))
    read, wrong = io.loadRobust(str(tmp_path / "new.osm"), projector)
    assert len(wrong) == 0
    theirs = [np.array([(p.x, p.y, p.z) for p in line]) for line in read.lineStringLayer]
    assert len(theirs) == len(found) == 658
    tree = cKDTree([line.mean(axis=0) for line in theirs])
    for one in found:
        own = one.enu_m(frame)
        off, which = tree.query(own.mean(axis=0))
        assert off < 2e-3
        assert np.abs(theirs[which] - own).max() < 2e-3
