"""Targets: settings, link profiles, ledgers, maps of features, stores, worlds, submissions of the benchmark."""

import gzip
import json
import sqlite3
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from random import Random
from typing import Any

from fuzz_folder import folder, on_file
from fuzz_mutators import bytes_mutated, text_mutated
from fuzz_target import FuzzTarget
from made_truth import made_truth, write_export
from small_maps import STREET
from store_helpers import EAGER, TILE, merge_once, report, tile_of_voxels

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.map_parameters import text_of, with_text
from gnd.deploy.fleet_config import load_fleet_config
from gnd.deploy.lab.groups import parse_groups
from gnd.deploy.status.thresholds import load_thresholds
from gnd.fleet_bus.config import check_endpoint
from gnd.fleet_bus.ledger import Ledger
from gnd.fleet_bus.ledger_file import read_ledger
from gnd.fleet_bus.links import load_link, read_links
from gnd.fleet_bus.settings_file import load_settings, read_toml
from gnd.fleet_bus.wire import WireBytes
from gnd.fleet_sim.feature_files import read_feature_layers, write_feature_layers
from gnd.fleet_sim.truth import read_truth, write_truth
from gnd.fleet_sim.world import read_world
from gnd.gnd_map.errors import GndError
from gnd.tile_store.check import check_store
from gnd.tile_store.compare import layer_info, layer_totals
from gnd.tile_store.feature_io.formats import read_features
from gnd.tile_store.feature_io.placement import Placement
from gnd.tile_store.feature_io.values import ImportOptions
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.status import status_of
from gnd.vehicle_agent.detect.shape_change import ShapeModel
from gnd.vehicle_agent.settings import load_agent
from studies.benchmark.files import read_json
from studies.benchmark.frames import IndexFrame
from studies.benchmark.kit import score as kit
from studies.benchmark.run import read_poses as read_benchmark_poses

ROOT = Path(__file__).resolve().parents[2]
MAPS = ROOT / "tests" / "feature_io" / "maps"


def _toml(load: Callable[[Path], Any]) -> Callable[[bytes], object]:
    return on_file("settings.toml", load)


def _text(read: Callable[[str], Any]) -> Callable[[bytes], object]:
    return lambda data: read(data.decode("utf-8", "replace"))


_AGENT = b'vehicle = "car-1"\ndrive = "a.mcap"\n[detect]\nmode = "paper"\n[report]\nlongest_s = 30.0\n'
_HYDRANTS = b'[[feature_layer]]\nname = "hydrants"\nkinds = ["hydrant"]\nsensor = "camera"\n'
_SHARD = b'codec = "standard"\n[merge]\nmode = "default"\n[confirmation]\nparked_h = 18.0\n'
_LAYER = b'features.layers=[{"name": "hydrants", "kinds": ["hydrant"], "sensor": "camera"}]'


def _ledger() -> bytes:
    path = folder("seeds") / "ledger.jsonl"
    if not path.exists():
        ledger = Ledger("a", path, now_ns=iter(range(10**9, 10**12, 10**9)).__next__)
        ledger.begin(load_link("3g"))
        for number in range(3):
            ledger.set_position(10.0 * number, 10**18 + number * 10**9)
            ledger.record("down", "tile", 100 + number, "13033/03021/23030/31321", head_bytes=70, took_s=0.01)
            ledger.record_wire(WireBytes(up=number, down=200 * number, segment_bytes=1448, header_bytes=52))
    return path.read_bytes()


# --- maps of features -------------------------------------------------------------------------------------------------

_GEOJSON = json.dumps({"type": "FeatureCollection", "features": [
    {"type": "Feature", "id": 1, "properties": {"kind": "traffic_sign", "subtype": "de274"},
     "geometry": {"type": "Point", "coordinates": [8.4, 49.0, 110.0]}},
    {"type": "Feature", "properties": {"kind": "lane_boundary"},
     "geometry": {"type": "LineString", "coordinates": [[8.4, 49.0, 110.0], [8.4001, 49.0, 110.0]]}},
]}).encode()  # fmt: skip


def _argoverse() -> bytes:
    def line(y: float) -> list[dict[str, float]]:
        return [{"x": 10.0 * k, "y": y, "z": 0.5} for k in range(3)]

    lane = {
        "id": 1, "is_intersection": False, "lane_type": "VEHICLE", "left_lane_boundary": line(2.0),
        "right_lane_boundary": line(-2.0), "left_lane_mark_type": "DASH_SOLID_WHITE",
        "right_lane_mark_type": "SOLID_WHITE", "successors": [], "predecessors": [],
        "left_neighbor_id": None, "right_neighbor_id": None,
    }  # fmt: skip
    crossing = {"id": 2, "edge1": line(3.0)[:2], "edge2": line(5.0)[:2]}
    area = {"id": 3, "area_boundary": [*line(6.0), *line(9.0)[::-1]]}
    return json.dumps({"pedestrian_crossings": {"2": crossing}, "lane_segments": {"1": lane},
                       "drivable_areas": {"3": area}}).encode()  # fmt: skip


def _features(name: str) -> Callable[[bytes], object]:
    placement = Placement.anchored(0.855, 0.146, 110.0) if name.endswith(".xodr") else None
    options = ImportOptions(other="things", placement=placement, trust_latlon=name.endswith(".osm"))

    def read(path: Path) -> object:
        return read_features(path, name, options)

    return on_file(name, read)


def _xml_mutated(data: bytes, rng: Random) -> bytes:
    """As text; sometimes with a document type, deep elements or very many of one."""
    kind = rng.randrange(40)
    if kind == 0:
        return b'<!DOCTYPE a [<!ENTITY b "c"><!ENTITY d "&b;&b;&b;">]>' + data
    if kind == 1:
        return data.replace(b"<node", b"<a>" * 3000 + b"<node", 1)
    if kind == 2:
        at = rng.randrange(len(data) + 1)
        return data[:at] + data[at : at + 300] * 40 + data[at:]
    return text_mutated(data, rng)


# --- stores -----------------------------------------------------------------------------------------------------------


@cache
def _store() -> bytes:
    path = folder("seeds") / "map.sqlite"
    with SqliteStore(path, EAGER) as store:
        store.put_tiles([tile_of_voxels(TILE, 1, 2, 3)])
        store.put_reports([report(1)])
        merge_once(store, 2, 3, 4)
        store.put_reports([report(2)])
        store.quarantine(b"nonsense", "because", "here")
    return path.read_bytes()


def _read_store(path: Path) -> object:
    """What `gnd map info --deep | status | history | quarantine | check` read, each by itself."""
    for beside in path.parent.glob(f"{path.name}-*"):
        beside.unlink()
    first = _tried(lambda: check_store(path))
    with SqliteStore(path, create=False, read_only=True) as store:
        reads = (
            store.layers, store.counts, store.quarantined, store.waiting_changes, store.queue_state,
            partial(store.history, "ndt", TILE), partial(store.provenance, "ndt", TILE, 2),
            partial(store.voxel_provenance, "ndt", TILE, 2), partial(layer_totals, store), partial(layer_info, store),
            partial(status_of, store), lambda: list(store.reports()), partial(store.heads, "ndt"),
        )  # fmt: skip
        found = [first, *(_tried(read) for read in reads)]
    refusals = [one for one in found if isinstance(one, GndError)]
    if refusals:
        raise refusals[0]
    return found


def _tried(read: Callable[[], Any]) -> object:
    try:
        return read()
    except GndError as error:
        return error


_CELLS: tuple[Any, ...] = (
    None, 0, -1, 1, 2**31, 2**63 - 1, -(2**63), 1.5, "", "x", "13033/03021/23031/22102", "[" * 3000, b"", b"\0" * 9,
    "\u00e9" * 100, b"x" * 5000,
)  # fmt: skip


def _store_mutated(data: bytes, rng: Random) -> bytes:
    """One to three cells of a table become something else, a column or a table goes; sometimes only bytes change."""
    if rng.randrange(3) == 0:
        return bytes_mutated(data, rng)
    path = folder("mutated") / "store.sqlite"
    path.write_bytes(data)
    db = sqlite3.connect(path, isolation_level=None)
    try:
        db.execute("PRAGMA journal_mode=delete")
        db.execute("PRAGMA writable_schema=on")
        _change_store(db, rng)
    except (sqlite3.Error, OverflowError, IndexError, UnicodeError):
        pass
    finally:
        db.close()
    return path.read_bytes()


def _change_store(db: sqlite3.Connection, rng: Random) -> None:
    tables = [name for (name,) in db.execute("SELECT name FROM sqlite_schema WHERE type = 'table' ORDER BY name")]
    full = [name for name in tables if db.execute(f"SELECT count(*) FROM {name}").fetchone()[0]]
    if rng.randrange(12) == 0:
        db.execute(f"DROP TABLE {rng.choice(tables)}")
    if rng.randrange(12) == 0:
        db.execute(f"PRAGMA user_version = {rng.choice((0, 1, 7, 99, -1))}")
    if rng.randrange(12) == 0:
        name = rng.choice(full)
        db.execute(f"ALTER TABLE {name} RENAME TO old")
        endless = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i FROM n"
        db.execute(f"CREATE VIEW {name} AS SELECT * FROM old WHERE (SELECT max(i) FROM ({endless})) > 0")
    if rng.randrange(3) == 0:  # STRICT tables take any value once they are no longer strict
        db.execute("UPDATE sqlite_schema SET sql = replace(replace(sql, 'STRICT', ''), 'NOT NULL', '')")
        db.execute("PRAGMA schema_version = 4242")
        return
    for _ in range(rng.randint(1, 3)):
        name = rng.choice(full)
        columns = [row[1] for row in db.execute(f"PRAGMA table_info({name})")]
        if columns:
            db.execute(f"UPDATE {name} SET {rng.choice(columns)} = ?", (rng.choice(_CELLS),))


def _loosened() -> bytes:
    """A store whose tables have lost their types: every cell can hold anything."""
    path = folder("seeds") / "loose.sqlite"
    path.write_bytes(_store())
    db = sqlite3.connect(path, isolation_level=None)
    db.execute("PRAGMA journal_mode=delete")
    db.execute("PRAGMA writable_schema=on")
    db.execute("UPDATE sqlite_schema SET sql = replace(replace(sql, 'STRICT', ''), 'NOT NULL', '')")
    db.execute("PRAGMA schema_version = 4242")
    db.close()
    return path.read_bytes()


def _old_store() -> bytes:
    return gzip.decompress((ROOT / "tests" / "tile_store" / "data" / "store_schema_7.sqlite.gz").read_bytes())


def _open_to_write(path: Path) -> object:
    """Opening brings a store of an older release up to date."""
    for beside in path.parent.glob(f"{path.name}-*"):
        beside.unlink()
    with SqliteStore(path, create=False) as store:
        return store.counts()


# --- benchmark and worlds ---------------------------------------------------------------------------------------------


@cache
def _export() -> Path:
    return write_export(folder("seeds") / "export", {"street-1": made_truth(1)})


def _submission(path: Path) -> object:
    worlds = kit.read_worlds(_export())
    return kit.score(worlds, kit.read_submission(path, worlds))


_CSV = b"world,vehicle,i,j,k,class\nstreet-1,merged,1,2,3,new\nstreet-1,vehicle-00,3,2,3,new\n"
_JSONL = (b'{"world": "street-1", "vehicle": "merged", "x": 1.5, "y": 2, "z": 0.5, "class": "new"}\n'
          b'{"world": "street-1", "vehicle": "vehicle-01", "i": 1, "j": 2, "k": 3, "class": "new"}\n')  # fmt: skip


def _in_export(at: str, read: Callable[[], Any]) -> Callable[[bytes], object]:
    """A file of an export changes; it is put back afterwards."""

    def call(data: bytes) -> object:
        path = _export() / at
        before = path.read_bytes()
        path.write_bytes(data)
        try:
            return read()
        finally:
            path.write_bytes(before)

    return call


def _export_target(at: str, mutate: Any, reads: tuple[str, ...] = ()) -> FuzzTarget:
    name = "benchmark-" + Path(at).name.replace(".", "-")
    return FuzzTarget(name, reads, f"export of the benchmark: {Path(at).name}",
                      _in_export(at, lambda: kit.read_worlds(_export())), lambda: [(_export() / at).read_bytes()],
                      mutate, refuses=(kit.SubmissionError, GndError), rounds=20)  # fmt: skip


def _npz_mutated(data: bytes, rng: Random) -> bytes:
    """An array changes under a right checksum, or bytes do."""
    import io
    import zipfile

    if rng.randrange(3) == 0:
        return bytes_mutated(data, rng)
    found = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(found, "w") as new:
        chosen = rng.choice(old.namelist())
        for name in old.namelist():
            body = old.read(name)
            if name == chosen:
                body = text_mutated(body[:128], rng) + body[128:] if rng.randrange(2) else bytes_mutated(body, rng)
            new.writestr(name, body)
    return found.getvalue()


def _npz_guarded(data: bytes, rng: Random) -> bytes:
    import zipfile

    try:
        return _npz_mutated(data, rng)
    except (zipfile.BadZipFile, ValueError, NotImplementedError, OSError, RuntimeError, EOFError, KeyError):
        return bytes_mutated(data, rng)
    except Exception:  # zlib.error and whatever a damaged archive leads to in the mutator itself
        return bytes_mutated(data, rng)


def _truth() -> bytes:
    path = folder("seeds") / "truth.npz"
    write_truth(made_truth(1), path)
    return path.read_bytes()


def _world() -> bytes:
    from gnd.fleet_sim.street import street
    from gnd.fleet_sim.world import write_world

    path = folder("seeds") / "world.json"
    if not path.exists():
        write_world(street(5).before if hasattr(street(5), "before") else street(5), path)
    return path.read_bytes()


def _feature_layers() -> bytes:
    from feature_values import feature_report

    from gnd.gnd_map.features import FeatureTile

    found = tuple(one.as_feature(k + 1) for k, one in enumerate(feature_report().snapped().tiles[0].found))
    path = folder("seeds") / "layers.json"
    write_feature_layers({"signs": (FeatureTile(TILE, 1, found),)}, path)
    return path.read_bytes()


def _benchmark_poses() -> bytes:
    head = "t_ns,x,y,z,qx,qy,qz,qw\n"
    return (head + "".join(f"{k}000000000,{k}.0,0.0,0.0,0.0,0.0,0.0,1.0\n" for k in range(1, 4))).encode()


def _frame() -> bytes:
    return (_export() / "worlds" / "street-1" / "frame.json").read_bytes()


_FEATURE_READS = "tile_store/feature_io/"
TARGETS = (
    FuzzTarget("toml", ("fleet_bus/settings_file.py:read_toml",), "TOML", _toml(read_toml), lambda: [_AGENT, _HYDRANTS],
               text_mutated),
    FuzzTarget("agent-settings", ("vehicle_agent/settings.py:load_agent",), "settings of an agent (TOML)",
               _toml(lambda path: load_agent(path, (), {}, {})), lambda: [_AGENT, _AGENT + _HYDRANTS], text_mutated),
    FuzzTarget("shard-settings", ("fleet_bus/settings_file.py:load_settings",), "settings of a shard (TOML)",
               _toml(lambda path: load_settings(ShardConfig, "shard", path, (), {}, {})), lambda: [_SHARD, _HYDRANTS],
               text_mutated),
    FuzzTarget("fleet-settings", ("deploy/fleet_config.py:load_fleet_config",), "settings of a fleet (TOML)",
               _toml(lambda path: load_fleet_config(path, {}, (), {})),
               lambda: [(ROOT / "deploy" / "fleet.toml").read_bytes()], text_mutated, rounds=40),
    FuzzTarget("alert-thresholds", ("deploy/status/thresholds.py:load_thresholds",), "thresholds of alerts (TOML)",
               _toml(load_thresholds), lambda: [(ROOT / "deploy" / "monitoring" / "alerts.toml").read_bytes()],
               text_mutated),
    FuzzTarget("changes-of-settings", (), "NAME=VALUE of --set",
               _text(lambda text: load_agent(None, (text,), {"vehicle": "car-1", "drive": "a.mcap"}, {})),
               lambda: [b"report.longest_s=30", b'live.connect=["tcp/a:1"]', b"detect.mode=paper", _LAYER],
               text_mutated),
    FuzzTarget("links", ("fleet_bus/links.py:read_links", "fleet_bus/links.py:load_link"), "link profiles (TOML)",
               _toml(read_links), lambda: [(ROOT / "deploy" / "links.toml").read_bytes()], text_mutated),
    FuzzTarget("endpoints", (), "endpoints", _text(check_endpoint),
               lambda: [b"tcp/127.0.0.1:7447", b"tls/[::1]:7447#a=b", b"quic/host:1"], text_mutated),
    FuzzTarget("lab-groups", ("deploy/lab/groups.py:parse_groups",), "groups of a lab", _text(parse_groups),
               lambda: [b"2x3g,1x4g", b"3g:2", b"4g"], text_mutated),
    FuzzTarget("merge-parameters", (), "parameters of the merge, kept in a store (JSON)",
               _text(lambda text: with_text(ShardConfig(), text)), lambda: [text_of(ShardConfig()).encode()],
               text_mutated),
    FuzzTarget("shape-model", (), "fitted trees (JSON)", _text(ShapeModel.from_json),
               lambda: [(ROOT / "vehicle_agent" / "detect" / "shape_change.json").read_bytes()], text_mutated,
               rounds=5),
    FuzzTarget("ledger", ("fleet_bus/ledger_file.py:read_ledger", "fleet_bus/ledger_rows.py:parse_rows"),
               "ledgers (JSON lines)", on_file("a.jsonl", read_ledger), lambda: [_ledger()], text_mutated),
    FuzzTarget("lanelet2", (f"{_FEATURE_READS}lanelet2_import.py:read_lanelet2",
                            f"{_FEATURE_READS}osm_document.py:read_osm",
                            f"{_FEATURE_READS}xml_spans.py:read_root", f"{_FEATURE_READS}formats.py:read_features",
                            f"{_FEATURE_READS}xml_spans.py:read_bytes"),
               "Lanelet2 (OSM XML)", _features("a.osm"),
               lambda: [STREET, (MAPS / "hatched_road_marking.osm").read_bytes()], _xml_mutated, rounds=60),
    FuzzTarget("opendrive", (f"{_FEATURE_READS}opendrive_import.py:read_opendrive",
                             f"{_FEATURE_READS}opendrive_import.py:read_xodr"), "OpenDRIVE (XML)", _features("a.xodr"),
               lambda: [(MAPS / "lane_sections.xodr").read_bytes(), (MAPS / "four_arms.xodr").read_bytes()],
               _xml_mutated, rounds=15),
    FuzzTarget("geojson", (f"{_FEATURE_READS}geojson_import.py:read_geojson",
                           f"{_FEATURE_READS}json_file.py:read_json"),
               "features as GeoJSON", _features("a.geojson"), lambda: [_GEOJSON], text_mutated),
    FuzzTarget("argoverse-map", (f"{_FEATURE_READS}argoverse.py:read_argoverse",), "Argoverse 2 maps (JSON)",
               _features("log_map_archive_a____PIT_city_1.json"), lambda: [_argoverse()], text_mutated),
    FuzzTarget("store", ("tile_store/sqlite_connection.py:open_reader", "tile_store/values.py:StoredTile.decode",
                         "tile_store/values.py:StoredTile.decode_gaussians"),
               "stores (SQLite)", on_file("map.sqlite", _read_store), lambda: [_store(), _loosened()], _store_mutated,
               rounds=15),
    FuzzTarget("old-store", ("tile_store/sqlite_connection.py:open_writer",), "stores of older releases (SQLite)",
               on_file("old.sqlite", _open_to_write), lambda: [_old_store()], _store_mutated, rounds=5),
    FuzzTarget("submission-csv", ("studies/benchmark/kit/score.py:read_submission",), "submissions (CSV)",
               on_file("s.csv", _submission), lambda: [_CSV], text_mutated, refuses=(kit.SubmissionError,), rounds=20),
    FuzzTarget("submission-jsonl", (), "submissions (JSON lines)", on_file("s.jsonl", _submission), lambda: [_JSONL],
               text_mutated, refuses=(kit.SubmissionError,), rounds=20),
    _export_target("benchmark.json", text_mutated, ("studies/benchmark/kit/score.py:read_worlds",)),
    _export_target("worlds/street-1/frame.json", text_mutated, ("studies/benchmark/kit/score.py:VoxelFrame.read",)),
    _export_target("worlds/street-1/map_before/gaussians.csv", text_mutated),
    _export_target("truth/street-1/voxels.npz", _npz_guarded, ("studies/benchmark/kit/score.py:ScoredWorld.read",)),
    FuzzTarget("benchmark-frame", ("studies/benchmark/frames.py:IndexFrame.read",), "frame of a benchmark (JSON)",
               on_file("frame.json", IndexFrame.read), lambda: [_frame()], text_mutated),
    FuzzTarget("benchmark-json", ("studies/benchmark/files.py:read_json",), "JSON of a benchmark",
               on_file("a.json", read_json), lambda: [_frame()], text_mutated),
    FuzzTarget("benchmark-poses", ("studies/benchmark/run.py:read_poses",), "poses of a benchmark (CSV)",
               on_file("poses.csv", read_benchmark_poses), lambda: [_benchmark_poses()], text_mutated),
    FuzzTarget("truth", ("fleet_sim/truth.py:read_truth",), "truth of a world (npz)", on_file("truth.npz", read_truth),
               lambda: [_truth()], _npz_guarded, rounds=20),
    FuzzTarget("world", ("fleet_sim/world.py:read_world", "fleet_sim/strict_json.py:parsed"), "worlds (JSON)",
               on_file("world.json", read_world), lambda: [_world()], text_mutated, rounds=2),
    FuzzTarget("feature-layers", ("fleet_sim/feature_files.py:read_feature_layers",), "feature layers (JSON)",
               on_file("layers.json", read_feature_layers), lambda: [_feature_layers()], text_mutated),
)  # fmt: skip
