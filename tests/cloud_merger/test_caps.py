"""How much one owner, or one sensor model, may decide where others look, too."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from merger_world import change_of, report_of
from test_agreement import GONE, NOTHING, NS, TILES, at, base_of, observed, take

from gnd.cloud_merger.caps import capped, groups_of
from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.erase import erase_vehicle
from gnd.cloud_merger.statements import STATEMENT, Report, Statements
from gnd.cloud_merger.verify import Verifier
from gnd.gnd_map.tile import Tile
from gnd.schemas.changes import ChangeReport
from gnd.tile_store.sql_trust import digest_of_owner
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoreConfig

TILE = TILES[0]


@pytest.fixture
def store(tmp_path: Path) -> Iterable[SqliteStore]:
    with SqliteStore(tmp_path / "map.sqlite", StoreConfig(merge_delay_s=0.0)) as store:
        store.put_tiles([Tile(TILE, 0, base_of(TILE))])
        yield store


def say(store: SqliteStore, number: int, vehicle: str, is_gone: bool, model: str = "") -> None:
    changes = GONE[TILE] if is_gone else NOTHING
    change = change_of(base_of(TILE), observed(TILE), changes, tile=TILE)  # type: ignore[arg-type]
    made: ChangeReport = at(number, report_of(number, change, vehicle=vehicle))
    take(store, [replace(made, sensor_model=model) if model else made], NS + number * 10**9)


def is_gone(store: SqliteStore) -> bool:
    """Whether the wall has gone from the map, which can be computed anew."""
    head = store.get("ndt", TILE)
    assert head is not None
    verifier = Verifier(store, ShardConfig("one", store.path))
    told = {verifier.version("ndt", TILE, one.version).status for one in store.history("ndt", TILE)}
    assert told <= {"same", "given"}
    return len(head.decode_gaussians().gaussians) < len(base_of(TILE))


@pytest.mark.parametrize("is_owned", [False, True])
def test_one_owner_does_not_outvote_two_others(store: SqliteStore, is_owned: bool) -> None:
    """Five vehicles say that a wall has gone, two that it stands: that is a change unless the five are one owner's."""
    for number in range(5):
        if is_owned:
            store.note_owner(f"v{number}", "a fleet", NS)
        say(store, 1 + number, f"v{number}", True)
    for number in range(5, 7):
        say(store, 1 + number, f"v{number}", False)
    assert is_gone(store) is not is_owned
    assert store.quarantined_vehicles() == frozenset()


def test_a_fleet_of_one_owner_heals_as_ever_and_one_stranger_does_not_stop_it(store: SqliteStore) -> None:
    for number in range(4):
        store.note_owner(f"v{number}", "a fleet", NS)
        say(store, 1 + number, f"v{number}", True)
    assert is_gone(store)
    say(store, 6, "stranger", False)
    assert is_gone(store)


def test_an_owner_alone_names_nobody(store: SqliteStore) -> None:
    """However many of its vehicles deny what a stranger claims, the stranger is not contradicted as a whole."""
    say(store, 1, "stranger", True)
    for number in range(2, 8):
        store.note_owner(f"v{number}", "a fleet", NS)
        say(store, number, f"v{number}", False)
    assert [one.refuted for one in store.vehicle_trusts() if one.vehicle == "stranger"] in ([], [0])
    assert not is_gone(store)


def test_one_model_does_not_outvote_six_of_others(store: SqliteStore) -> None:
    for number in range(11):
        say(store, 1 + number, f"v{number}", True, "Defective-64")
    assert is_gone(store)
    for number in range(11, 17):
        say(store, 1 + number, f"v{number}", False, f"Other-{number}")
    assert not is_gone(store)


def test_weights_are_capped_voxel_by_voxel_and_their_sum_stays() -> None:
    rows = np.zeros(8, STATEMENT)
    rows["voxel_id"], rows["report"], rows["weight"] = [1, 1, 1, 1, 1, 2, 2, 2], [0, 1, 2, 3, 4, 0, 1, 2], 1.0
    change = change_of(base_of(TILE), observed(TILE), {}, tile=TILE)
    reports = tuple(Report(str(k), change, vehicle=str(k), received_ns=NS) for k in range(5))
    owners = {str(k): ((0, "a"),) for k in range(4)}
    found = capped(Statements(reports, rows), owners).rows["weight"]
    assert found[:5].sum() == pytest.approx(5.0)
    assert found[:4].sum() / found[:5].sum() == pytest.approx(2 / 3)  # one other, and one beyond
    assert (found[5:] == 1.0).all()  # nobody else looks


def test_groups_are_numbered_by_name_whatever_their_order() -> None:
    assert groups_of(["b", "", "a", "b"]).tolist() == [1, -1, 0, 1]


def test_a_sealed_report_tells_the_owner_once_and_a_new_one_from_then_on(tmp_path: Path) -> None:
    with SqliteStore(tmp_path / "map.sqlite") as store:
        for since_ns, owner in ((5, "a"), (7, "a"), (9, "b"), (11, "a")):
            store.note_owner("car", owner, since_ns)
        a, b = digest_of_owner("a"), digest_of_owner("b")
        assert store.owners_of(["car", "nobody"]) == {"car": ((5, a), (9, b), (11, a))}


def test_an_erased_vehicle_keeps_its_owner_under_another_name(store: SqliteStore) -> None:
    """Else versions in which its owner was capped could not be computed any more."""
    for number in range(5):
        store.note_owner(f"v{number}", "a fleet", NS)
        say(store, 1 + number, f"v{number}", True)
    for number in range(5, 7):
        say(store, 1 + number, f"v{number}", False)
    assert not is_gone(store)
    done = erase_vehicle(store, ShardConfig("one", store.path), "v0")
    assert done
    assert not is_gone(store)
    assert store.owners_of(["v0"]) == {}
