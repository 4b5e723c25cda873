"""Those who lie before anybody else comes: they are outvoted by those who come later, whatever map these have."""

from collections.abc import Iterable
from pathlib import Path

import pytest
from merger_world import WALL, change_of, report_of, seen_by
from test_agreement import (
    BUILT,
    GONE,
    NOTHING,
    NS,
    TILES,
    at,
    base_of,
    new_of,
    observed,
    says,
    take,
    wall_of,
)

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.verify import Verifier
from gnd.gnd_map.tile import Tile
from gnd.schemas.changes import ChangeReport
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoreConfig

HOUR_NS = 3600 * 10**9
LIE = {tile: {**GONE[tile], **BUILT[tile]} for tile in TILES}


@pytest.fixture
def store(tmp_path: Path) -> Iterable[SqliteStore]:
    with SqliteStore(tmp_path / "map.sqlite", StoreConfig(merge_delay_s=0.0)) as store:
        store.put_tiles([Tile(tile, 0, base_of(tile)) for tile in TILES])
        yield store


def sees_the_truth(store: SqliteStore, number: int, vehicle: str) -> list[ChangeReport]:
    """What an honest vehicle says that has the newest version: what is false in it, it finds changed."""
    found = []
    for k, tile in enumerate(TILES):
        head = store.get("ndt", tile)
        assert head is not None
        held = head.decode_gaussians().gaussians
        there = set(held.voxel_id.tolist())
        changes: dict[int, object] = {voxel: WALL for voxel in wall_of(tile) if voxel not in there}
        changes |= {voxel: None for voxel in new_of(tile) if voxel in there}
        change = change_of(held, observed(tile), seen_by(vehicle, changes), tile=tile)  # type: ignore[arg-type]
        found.append(at(number, report_of(100 * number + k, change, vehicle=vehicle)))
    return found


def is_true(store: SqliteStore) -> bool:
    """Whether walls stand where they stand, and nowhere else."""
    for tile in TILES:
        head = store.get("ndt", tile)
        assert head is not None
        if set(head.decode_gaussians().gaussians.voxel_id) != set(base_of(tile).voxel_id):
            return False
    return True


def all_verified(store: SqliteStore) -> bool:
    verifier = Verifier(store, ShardConfig("one", store.path))
    told = [verifier.version("ndt", t, one.version) for t in TILES for one in store.history("ndt", t)]
    return {one.status for one in told} <= {"same", "given"}


@pytest.mark.parametrize("liars", [2, 3, 4])
@pytest.mark.parametrize("has_newest", [False, True])
def test_liars_first_then_two_more_honest_ones(store: SqliteStore, liars: int, has_newest: bool) -> None:
    """All within half an hour; the honest ones have the old map, or the false one, as it is when each comes."""
    for number in range(liars):
        take(store, says(1 + number, f"bad{number}", LIE))
    assert not is_true(store)
    for number in range(liars, 2 * liars + 2):
        name = f"honest{number}"
        take(store, sees_the_truth(store, 1 + number, name) if has_newest else says(1 + number, name, NOTHING))
    assert is_true(store)
    assert store.quarantined_vehicles() <= {f"bad{number}" for number in range(liars)}
    take(store, says(40, "last", {tile: {wall_of(tile)[0]: None} for tile in TILES}))
    assert store.quarantined_vehicles() == {f"bad{number}" for number in range(liars)}
    assert is_true(store)
    assert all_verified(store)


@pytest.mark.parametrize("apart_h", [0, 2])
@pytest.mark.parametrize("has_newest", [False, True])
def test_honest_ones_hours_later(store: SqliteStore, apart_h: int, has_newest: bool) -> None:
    """The lie is folded into the map; the honest ones come hours later, together or each in a window of its own."""
    for number in range(3):
        take(store, says(1 + number, f"bad{number}", LIE), NS)
    for number in range(5):
        at_ns = NS + (3 + number * apart_h) * HOUR_NS
        turn = 1 + (180 + 60 * number * apart_h) + number
        name = f"honest{number}"
        take(store, sees_the_truth(store, turn, name) if has_newest else says(turn, name, NOTHING), at_ns)
    assert is_true(store)
    assert not any(one.startswith("honest") for one in store.quarantined_vehicles())
    assert all_verified(store)


def test_two_liars_and_two_of_another_day(store: SqliteStore) -> None:
    for number in range(2):
        take(store, says(1 + number, f"bad{number}", LIE), NS)
    for number in range(2, 4):
        take(store, says(1441 + number, f"bad{number}", LIE), NS + 24 * HOUR_NS)
    for number in range(4, 10):
        turn = 2881 + number
        take(store, sees_the_truth(store, turn, f"honest{number}"), NS + 48 * HOUR_NS)
    assert is_true(store)
    assert not any(one.startswith("honest") for one in store.quarantined_vehicles())


def test_liars_that_come_again(store: SqliteStore) -> None:
    """The same three again on another day, after five have taken their lie back: the map stays, and they are named."""
    for number in range(3):
        take(store, says(1 + number, f"bad{number}", LIE), NS)
    for number in range(5):
        take(store, sees_the_truth(store, 181 + number, f"honest{number}"), NS + 3 * HOUR_NS)
    assert is_true(store)
    for number in range(3):
        take(store, says(1441 + number, f"bad{number}", LIE), NS + 24 * HOUR_NS)
    assert is_true(store)
    for number in range(5):
        take(store, sees_the_truth(store, 1451 + number, f"honest{number}"), NS + 24 * HOUR_NS + 10**9)
    assert is_true(store)
    assert not any(one.startswith("honest") for one in store.quarantined_vehicles())
    assert all_verified(store)
