"""No decoder without a fuzz target: whatever is named like one is in a target's `reads`, or below with a reason."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import fuzz_table
import pytest
from fuzz_all import TARGETS
from fuzz_paths import ROOT
from fuzz_table import PAGE, counts_table, table

FOLDERS = (
    "gnd_map", "schemas", "fleet_bus", "tile_client", "tile_store", "vehicle_agent", "cloud_merger", "fleet_sim",
    "deploy", "src/gnd", "studies/benchmark",
)  # fmt: skip
NAMED_LIKE_ONE = re.compile(r"(decode|read|load|parse|unpack|open|import)(d|ing|_.*)?_?$")

OPENS = "opens, reads or starts something of the running system: no bytes from outside come in by it"
OWN_RUN = "reads what a run of this program has written into its own folder a moment before"
OWN_FOLDER = "the part's own identity folder, read by the `cryptography` library; nobody else writes there"
OF_TARGET = "takes what another target has read already"
NOT_BYTES = "is named like a decoder and decodes nothing"
BEHIND = "its tables and clouds go through readers that have targets, and `named_damage` stands around it"
EXCEPTIONS = {
    "cloud_merger/reception.py:Reception.open": OPENS,
    "cloud_merger/release/collector.py:HealthCollector.open": OPENS,
    "cloud_merger/states.py:States.open": OPENS,
    "cloud_merger/stored.py:decode_state": "a tile's codec and `TileMemory.decode`, both with targets",
    "gnd_map/codec/volume.py:LaidOut.read": "a part of the range-coded codecs, which have targets",
    "cloud_merger/stored.py:Bases.decoded": "the codec of a stored tile, which has a target",
    "deploy/account.py:FleetResults.read": OWN_RUN,
    "deploy/chaos/checks.py:read_outbox": OWN_RUN,
    "deploy/chaos/clients.py:read_receipts": OWN_RUN,
    "deploy/chaos/street.py:read_street": "a file of the checkout",
    "deploy/chaos/wire.py:Wires.open": OPENS,
    "deploy/features_cli.py:import_": "a command; `read_features` has a target",
    "deploy/lanes_cli.py:import_": "a command; `read_features` has a target",
    "deploy/lab/counters.py:read_counts": "what the system's own tools print",
    "deploy/lab/counters.py:read_drops": "what the system's own tools print",
    "deploy/lab/counters.py:parse_ss": "what the system's own tools print",
    "deploy/lab/hosts/cloud.py:read_times": OWN_RUN,
    "deploy/lab/hosts/faults.py:parse_faults": "an option of a command",
    "deploy/lab/lab.py:open_lab": OPENS,
    "deploy/lab/relay.py:Wire.read": OPENS,
    "deploy/lab/relay.py:read_account": OWN_RUN,
    "deploy/lab/run.py:read_ledgers": "`read_ledger` of each file",
    "deploy/load/client.py:read_accounts": OWN_RUN,
    "deploy/load/command.py:load": "a command",
    "deploy/load/drives.py:read_street": OWN_RUN,
    "deploy/map_export/autoware.py:read_cell": "reads what `gnd map export` has written; PCD has a target",
    "deploy/map_export/autoware.py:read_metadata": "reads what `gnd map export` has written",
    "deploy/map_export/scene.py:read_scene": "a store, which has a target",
    "deploy/map_export/tile_feeds.py:open_feed": OPENS,
    "deploy/map_use.py:read_ways": "`read_way` of each file",
    "deploy/report/finished_run.py:read_finished_run": OWN_RUN,
    "deploy/traffic_cli.py:load_links": "`load_link` of each name",
    "fleet_bus/bus.py:open_bus": OPENS,
    "fleet_bus/connection.py:Connection.open": OPENS,
    "fleet_bus/gate.py:read_members": "`MemberList.decode` of a file of the own folder",
    "fleet_bus/identity/folder.py:load_identity": OWN_FOLDER,
    "fleet_bus/identity/folder.py:load_key": OWN_FOLDER,
    "fleet_bus/seal_keys.py:load_authority": OWN_FOLDER,
    "fleet_bus/seal_keys.py:load_signer": OWN_FOLDER,
    "fleet_bus/ledger_file.py:read_run": "`read_ledger` of each file",
    "fleet_bus/router.py:open_router": OPENS,
    "fleet_bus/wire.py:WireMeter.read": OPENS,
    "fleet_sim/truth.py:load_or_make_truth": "`read_truth`",
    "gnd_map/codec/coding.py:Coder.reading": "inside of every range-coded target",
    "gnd_map/codec/prior_sets.py:unpack": "tables that are part of the program",
    "gnd_map/codec/priors.py:unpack": "tables that are part of the program",
    "gnd_map/codec/rans_tables.py:unpack": "tables that are part of the program",
    "gnd_map/codec/rans_tile.py:read_numbers": "inside of every target by sums",
    "gnd_map/sight.py:read_out": NOT_BYTES,
    "schemas/catalog_signature.py:decode_catalog_signature": OF_TARGET,
    "schemas/district_list.py:decode_district_list": OF_TARGET,
    "schemas/wire.py:parse": "inside of every target of a message",
    "tile_store/feature_io/stored.py:import_features": OF_TARGET,
    "tile_store/feature_io/stored.py:load_features": "a store, which has a target",
    "tile_store/location.py:open_store": OPENS,
    "tile_store/copying/ends.py:End.reading": OPENS,
    "tile_store/bodies.py:Bodies.read": "the codec of a stored tile, which has a target",
    "tile_store/objects.py:open_objects": OPENS,
    "tile_store/postgres_connection.py:DatabaseClock.read_with": OPENS,
    "tile_store/sql_roads.py:open_roads": OPENS,
    "tile_store/sql_trials.py:open_trial": "a store, which has a target",
    "tile_store/sql_trials.py:open_trials": "a store, which has a target",
    "tile_store/sqlite_store.py:SqlStore.load": "a store, which has a target",
    "tile_store/store.py:Store.load": "an interface",
    "tile_store/values.py:StoredTile.decode_features": "codec 32, which has a target",
    "vehicle_agent/importer.py:import_recording": "`open_recording`, which the targets of importers call",
    "vehicle_agent/importer.py:import_opened": OF_TARGET,
    "vehicle_agent/importer.py:open_recording": "every target of an importer calls it",
    "vehicle_agent/importer_cli.py:import_drives": "a command",
    "vehicle_agent/importers/apollo.py:open_apollo": BEHIND,
    "vehicle_agent/importers/argoverse_logs.py:open_argoverse": BEHIND,
    "vehicle_agent/importers/planes.py:open_planes": BEHIND,
    "vehicle_agent/importers/radiate.py:open_radiate": BEHIND,
    "vehicle_agent/importers/udp_packets.py:BoundedFile.read": "inside of the targets of captures",
    "vehicle_agent/link/feature_tiles_on_the_bus.py:open_feature_tiles": OPENS,
    "vehicle_agent/link/link.py:open_link": OPENS,
    "vehicle_agent/map_align/sources.py:open_side": "a store or a drive, which have targets",
    "vehicle_agent/memory.py:MemoryMeter.read": OPENS,
    "vehicle_agent/sources/opening.py:open_source": OPENS,
    "vehicle_agent/sources/plain_keys.py:open_plain": OPENS,
    "vehicle_agent/sources/ros2.py:open_ros2": OPENS,
    "vehicle_agent/vehicle.py:open_vehicle": OPENS,
    "studies/benchmark/files.py:read_cloud": "reads what `gnd benchmark export` has written; PLY of our own",
}


def functions(body: list[ast.stmt], before: str = "") -> Iterator[tuple[str, ast.FunctionDef]]:
    """Of a module or a class, with the names of the classes in front."""
    for one in body:
        if isinstance(one, ast.ClassDef) and not one.name.startswith("_"):
            yield from functions(one.body, f"{before}{one.name}.")
        if isinstance(one, ast.FunctionDef):
            yield before + one.name, one


@cache
def named_like_decoders() -> set[str]:
    """Public functions with arguments, but for properties."""
    found = set()
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).rglob("*.py")):
            if "generated" in path.parts or (folder == "src/gnd" and path.parent.name != "gnd"):
                continue
            for name, function in functions(ast.parse(path.read_text(encoding="utf-8")).body):
                decorators = {getattr(one, "id", "") for one in function.decorator_list}
                if NAMED_LIKE_ONE.match(name.split(".")[-1]) and "property" not in decorators:
                    found.add(f"{path.relative_to(ROOT)}:{name}")
    return found


def covered() -> set[str]:
    return {entry for target in TARGETS.values() for entry in target.reads}


def test_every_decoder_has_a_target_or_a_reason() -> None:
    assert sorted(named_like_decoders() - covered() - set(EXCEPTIONS)) == []


def test_no_target_and_no_exception_names_what_is_not_there() -> None:
    private = {entry for entry in covered() if ":_" in entry}
    assert sorted((covered() - private | set(EXCEPTIONS)) - named_like_decoders()) == []
    for entry in private:
        assert Path(ROOT / entry.split(":")[0]).is_file()


def test_a_new_decoder_would_be_missed() -> None:
    assert NAMED_LIKE_ONE.match("decode_new_thing")
    assert NAMED_LIKE_ONE.match("read_new_file")
    assert not NAMED_LIKE_ONE.match("reading_room_of")
    assert len(named_like_decoders()) > 120


def test_the_page_lists_the_targets() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert table() in page, "run: python tests/fuzz/fuzz_table.py"
    assert counts_table() in page, "run: python tests/fuzz/fuzz_table.py"


def test_adding_without_runs_says_so(tmp_path, monkeypatch) -> None:
    counts = fuzz_table.COUNTS.read_bytes()
    monkeypatch.setattr(fuzz_table, "RESULTS", tmp_path / "results.jsonl")
    with pytest.raises(SystemExit, match=r"is not there: no run of tests/fuzz/run.py since the last --add"):
        fuzz_table.add_results()
    assert fuzz_table.COUNTS.read_bytes() == counts
