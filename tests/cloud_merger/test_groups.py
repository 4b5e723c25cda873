"""Vehicles that say the same false things are listed together; those that err alike by chance are not."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from test_agreement import BALL, GONE, NOTHING, TILES, base_of, new_of, observed, says, take, wall_of
from test_standing import changed, is_verified, of, reasons

from gnd.cloud_merger.groups import groups_of
from gnd.deploy.cli import gnd
from gnd.gnd_map.tile import Tile
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoreConfig


@pytest.fixture
def store(tmp_path: Path) -> Iterable[SqliteStore]:
    with SqliteStore(tmp_path / "map.sqlite", StoreConfig(merge_delay_s=0.0)) as store:
        store.put_tiles([Tile(tile, 0, base_of(tile)) for tile in TILES])
        yield store


def some(seed: int) -> dict:
    """Twenty of the voxels of a wall and beside it, in each tile."""
    rng, lie = np.random.default_rng(seed), {}
    for tile in TILES:
        gone = rng.choice(wall_of(tile), 16, replace=False).tolist()
        built = rng.choice(new_of(tile), 16, replace=False).tolist()
        lie[tile] = dict.fromkeys(gone) | dict.fromkeys(built, BALL)
    return lie


def honest_ones(store: SqliteStore, first: int) -> None:
    for number, name in enumerate("abcdef", first):
        take(store, says(number, name, NOTHING))
    take(store, says(first + 9, "last", {tile: {wall_of(tile)[0]: None} for tile in TILES}))


def test_those_who_say_the_same_are_a_group_and_who_lies_alone_is_not(store: SqliteStore) -> None:
    for number, (name, seed) in enumerate([("x", 1), ("y", 1), ("alone", 2)], 1):
        take(store, says(number, name, some(seed)))
    honest_ones(store, 5)
    assert store.quarantined_vehicles() == {"x", "y", "alone"}
    (group,) = groups_of(store)
    assert group.vehicles == ("x", "y")
    assert group.shared >= 3 * 32 > 3 * group.by_chance
    run = CliRunner()
    assert "x, y say the same false things" in run.invoke(gnd, ["vehicles", "list", str(store.path)]).output
    assert "x, y say the same false things" in run.invoke(gnd, ["vehicles", "why", str(store.path), "y"]).output
    assert "same false things" not in run.invoke(gnd, ["vehicles", "why", str(store.path), "alone"]).output


def test_two_that_delete_all_that_they_see_agree_by_chance_alone(store: SqliteStore) -> None:
    all_gone = {tile: dict.fromkeys(observed(tile)) for tile in TILES}
    for number, name in enumerate("xy", 1):
        take(
            store,
            says(number, name, {t: {v: None for v in ids if v in base_of(t).voxel_id} for t, ids in all_gone.items()}),
        )
    honest_ones(store, 5)
    assert store.quarantined_vehicles() == {"x", "y"}
    assert groups_of(store) == []


def test_a_store_in_which_nobody_is_contradicted_has_no_groups(store: SqliteStore) -> None:
    take(store, [*says(1, "a", GONE), *says(2, "b", GONE)])
    assert groups_of(store) == []


def two_tiles(lie: dict, names: str, first: int) -> list:
    """Vehicles that lie alike in two tiles, where six others see that it is not so."""
    told = [one for n, name in enumerate(names, first) for one in of(n, name, {tile: lie[tile] for tile in TILES[:2]})]
    for number, name in enumerate("abcdef", first + 10):
        told += of(number, name, {tile: {} for tile in TILES[:2]})
    return told


@pytest.mark.parametrize("are_known", [False, True])
def test_the_vehicles_of_a_group_have_one_vote(store: SqliteStore, are_known: bool) -> None:
    """Four say that a wall has gone, two that it stands: a change, unless the four have said the same false things."""
    if are_known:
        take(store, two_tiles(some(1), "wxyz", 1))
        assert [one.vehicles for one in groups_of(store)] == [tuple("wxyz")]
        assert store.quarantined_vehicles() == frozenset()
    last = TILES[3]
    for number, name in enumerate("wxyz", 30):
        take(store, of(number, name, {last: GONE[last]}))
    assert changed(store, last) == (0 if are_known else 48)
    assert ((last, "share") in reasons(store, "w")) is are_known  # one witness, whose claims are many
    for number, name in enumerate("gh", 40):
        take(store, of(number, name, {last: {}}))
    assert changed(store, last) == (0 if are_known else 48)
    assert is_verified(store)


def test_who_becomes_a_group_later_has_one_vote_in_open_windows_too(store: SqliteStore) -> None:
    last = TILES[3]
    for number, name in enumerate("wxyz", 1):
        take(store, of(number, name, {last: GONE[last]}))
    assert changed(store, last) == 48
    take(store, two_tiles(some(1), "wxyz", 5))
    assert changed(store, last) == 0
    assert is_verified(store)


def test_a_group_names_and_silences_nobody_alone(store: SqliteStore) -> None:
    """Four of a group deny what a fifth finds: it is heard, and not contradicted as a whole."""
    take(store, two_tiles(some(1), "wxyz", 1))
    last = TILES[3]
    take(store, of(30, "honest", {last: GONE[last]}))
    for number, name in enumerate("wxyz", 31):
        take(store, of(number, name, {last: {}}))
    take(store, [*of(40, "second", {last: GONE[last]}), *of(41, "third", {last: GONE[last]})])
    assert changed(store, last) == 48
    assert "honest" not in store.unheard_vehicles()


def test_road_works_that_all_report_make_no_group(store: SqliteStore) -> None:
    """True changes that a majority with an old map denies at first: nobody is a group for having seen the same."""
    for number, name in enumerate("abc", 1):
        take(store, says(number, name, GONE))
    for number, name in enumerate("de", 5):
        take(store, says(number, name, NOTHING))
    assert groups_of(store) == []
