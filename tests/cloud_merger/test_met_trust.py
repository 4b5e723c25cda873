"""What vehicles met and did not decide upon: the cloud's own switch, and what those who lie with it can do."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from merger_world import (
    BALL,
    GROUND,
    VOXEL_BY_VOXEL,
    WALL,
    change_of,
    gaussians_of,
    report_id,
    report_of,
    seen_by,
    sha_of,
)
from test_agreement import NOTHING, NS, TILES, at, base_of, new_of, observed, says, shas, take, wall_of
from test_standing import a_store, little, of

from gnd.cloud_merger.belief import ShiftTests
from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.expander import rows_of
from gnd.cloud_merger.map_parameters import text_of, with_text
from gnd.cloud_merger.memory import TileMemory
from gnd.cloud_merger.merge import MergeParameters
from gnd.cloud_merger.statements import Report, is_met
from gnd.cloud_merger.stored import decode_state
from gnd.cloud_merger.verify import Verifier
from gnd.cloud_merger.window import TileState, WindowMerger, fold
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport
from gnd.tile_store.sqlite_store import SqliteStore

ON = MergeParameters(together=True)
FIRST, LAST = TILES[0], TILES[-1]


@pytest.fixture
def store(tmp_path: Path) -> Iterable[SqliteStore]:
    with a_store(tmp_path / "map.sqlite") as store:
        yield store


def met(number: int, vehicle: str, ids: dict[TileId, list[int]], cells: int = 10) -> list[ChangeReport]:
    """A report of some tiles: it is unsure of some voxels, all else is as it was."""
    made = []
    for k, (tile, some) in enumerate(ids.items()):
        seen = sorted(set(observed(tile)) - set(some))
        change = change_of(base_of(tile), seen, {}, tile=tile)
        change = replace(change, unsure=gaussians_of(dict.fromkeys(some, BALL), cells, cells))
        made.append(at(number, report_of(100 * number + k, change, vehicle=vehicle)))
    return made


def everywhere() -> dict[TileId, list[int]]:
    return {tile: new_of(tile) for tile in TILES}


def new(store: SqliteStore, tile: TileId) -> int:
    """Voxels that the tile holds and the base does not."""
    head = store.get("ndt", tile)
    assert head is not None
    return len(np.setdiff1d(head.decode_gaussians().gaussians.voxel_id, base_of(tile).voxel_id))


def is_verified(store: SqliteStore) -> bool:
    verifier = Verifier(store, ShardConfig("one", store.path))
    return {one.status for tile in TILES for one in verifier.history("ndt", tile)} <= {"same", "given"}


# ---- switched off


@pytest.mark.parametrize("colluders", ["xy", "xyz"])
def test_by_default_it_counts_for_nothing_however_many_tell_of_it(store: SqliteStore, colluders: str) -> None:
    before = shas(store)
    for number, name in enumerate(colluders, 1):
        take(store, met(number, name, everywhere(), 19))
    assert shas(store) == before
    assert not store.dirty_tiles()
    assert list(store.waiting_changes()) == []


def test_a_report_that_only_tells_of_it_confirms_the_version_and_is_not_merged() -> None:
    (report,) = met(1, "car", {FIRST: new_of(FIRST)})
    assert [row.is_quiet for row in rows_of(report, NS)] == [True]
    assert [row.is_quiet for row in rows_of(report, NS, together=True)] == [False]


def merger(epoch: Gaussians, rules: MergeParameters) -> WindowMerger:
    return WindowMerger(rules, VOXEL_BY_VOXEL, ShiftTests(), {sha_of(epoch): epoch}, frozenset())


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_switched_off_a_window_is_the_same_with_and_without_it(seed: int) -> None:
    """The tile, what waits, and all that is remembered, parked things too, over two windows."""
    rng, epoch = np.random.default_rng(seed), gaussians_of({0: GROUND, 1: WALL})
    told: list[list[Report]] = [[], []]
    for k in range(int(rng.integers(2, 9))):
        ids = np.flatnonzero(rng.random(40) < 0.6) + 2
        unsure, new_ids = (ids[rng.random(len(ids)) < 0.5].tolist() for _ in range(2))
        new_ids = sorted(set(new_ids) - set(unsure))
        change = change_of(epoch, [0, 1, *new_ids], dict.fromkeys(new_ids, BALL), change_class=ChangeClass.NEW)
        change = replace(change, unsure=gaussians_of(dict.fromkeys(unsure, BALL), 10, 10))
        times = {"first_ns": NS + k * 10**12, "last_ns": NS + k * 10**12, "received_ns": NS + k * 10**12}
        told[k % 2].append(Report(report_id(k), change, vehicle=f"car-{rng.integers(5)}", **times))
    made = (lambda one: one), (lambda one: replace(one, change=replace(one.change, unsure=Gaussians.empty())))
    with_it, without = (_two_windows(epoch, told, strip, MergeParameters()) for strip in made)
    assert with_it == without


def _two_windows(
    epoch: Gaussians, told: list[list[Report]], made: Callable[[Report], Report], rules: MergeParameters
) -> list[object]:
    state, found = TileState(epoch, TileMemory()), list[object]()
    for reports in told:
        window = merger(epoch, rules).merge(state, [made(one) for one in reports], None)
        state = fold(state, window)
        found += [window.gaussians, window.gated.waiting, window.standings(0), state.memory.encode()]
    return found


def test_switching_it_off_takes_remembered_votes_away_too() -> None:
    """Two have met something that many saw empty, and it is remembered; by rules without it the next two decide
    nothing, and nothing is remembered any more.
    """
    epoch = gaussians_of({0: GROUND, 1: WALL})

    def one(number: int, vehicle: str, unsure: bool) -> Report:
        change = change_of(epoch, [0, 1] if unsure else [0, 1, 7], {})
        change = replace(change, unsure=gaussians_of({7: BALL} if unsure else {}, 10, 10))
        at_ns = NS + number * 10**13
        return Report(report_id(number), change, vehicle=vehicle, first_ns=at_ns, last_ns=at_ns, received_ns=at_ns)

    state = TileState(epoch, TileMemory())
    for window in ([one(k, f"empty-{k}", False) for k in range(3)], [one(4, "a", True), one(5, "b", True)]):
        state = fold(state, merger(epoch, ON).merge(state, window, None))
    assert is_met(state.memory.claims).sum() == 2
    window = [one(9, "c", True), one(10, "d", True)]
    for rules, published, remembered in ((ON, 1, 0), (MergeParameters(), 0, 0)):
        merged = merger(epoch, rules).merge(state, window, None)
        assert len(merged.gated.merged.changed) == published
        assert is_met(fold(state, merged).memory.claims).sum() == remembered


def test_a_store_is_switched_off_and_every_version_is_still_what_its_journal_gives(store: SqliteStore) -> None:
    few = {tile: new_of(tile)[:4] + new_of(tile)[24:28] for tile in TILES}
    for number, name in enumerate("ab", 1):
        take(store, met(number, name, few), merge=ON)
    assert [new(store, tile) for tile in TILES] == [8] * 4
    take(store, says(3, "c", {tile: {new_of(tile)[40]: BALL} for tile in TILES}))
    assert [new(store, tile) for tile in TILES] == [0] * 4
    assert is_verified(store)


def test_texts_of_before_are_of_rules_that_always_added_it_up() -> None:
    config = ShardConfig(merge=ON)
    older = text_of(ShardConfig()).replace('"together":false,', "")
    assert '"together"' not in older
    assert with_text(ShardConfig(), older).merge.together
    assert with_text(ShardConfig(), text_of(config)).merge.together
    assert not with_text(config, text_of(ShardConfig())).merge.together


# ---- switched on


def test_what_two_met_is_the_word_of_one_witness(store: SqliteStore) -> None:
    """As much of a tile as one vehicle is believed is published; of more, nothing."""
    few = new_of(FIRST)[:4] + new_of(FIRST)[24:28]
    for number, name in enumerate("ab", 1):
        take(store, met(number, name, {FIRST: few, LAST: new_of(LAST)}), merge=ON)
    assert (new(store, FIRST), new(store, LAST)) == (8, 0)
    assert {(one.vehicle, one.reason, one.voxels) for one in store.waiting_changes()} == {("a", "share", 48)}
    assert sum(one.alone for one in store.days_alone()) == 8
    assert sum(one.shared for one in store.days_alone()) == 0
    assert is_verified(store)


def test_who_met_something_is_no_witness_of_another_ones_claim(store: SqliteStore) -> None:
    wall = {LAST: dict.fromkeys(new_of(LAST), BALL)}
    take(store, of(1, "claims", wall), merge=ON)
    for number, name in enumerate("xyz", 2):
        take(store, met(number, name, {LAST: new_of(LAST)}, 19), merge=ON)
    assert new(store, LAST) == 0
    take(store, of(5, "second", wall), merge=ON)
    assert new(store, LAST) == 48
    assert is_verified(store)


def test_what_others_confirm_vouches_for_what_was_only_met(store: SqliteStore) -> None:
    """Half a wall is claimed by both, the rest was met by both: an honest pair on a motorway."""
    claimed, rest = new_of(LAST)[:24], new_of(LAST)[24:]
    for number, name in enumerate("ab", 1):
        change = change_of(base_of(LAST), sorted(set(observed(LAST)) - set(rest)),
                           seen_by(name, dict.fromkeys(claimed, BALL)), tile=LAST)  # fmt: skip
        change = replace(change, unsure=gaussians_of(dict.fromkeys(rest, BALL), 10, 10))
        take(store, [at(number, report_of(100 * number, change, vehicle=name))], merge=ON)
    assert new(store, LAST) == 48
    assert is_verified(store)


@pytest.mark.parametrize("colluders", ["xy", "xyz"])
def test_who_lies_so_is_bounded_and_named(store: SqliteStore, colluders: str) -> None:
    """Colluders tell of a wall in three tiles, and of a little in one where nobody else comes: of each tile no more
    than one is believed; once others have seen nothing there, nothing anywhere.
    """
    few = {LAST: new_of(LAST)[:4] + new_of(LAST)[24:28]}
    told = {tile: new_of(tile) for tile in TILES[:3]} | few
    for number, name in enumerate(colluders, 1):
        take(store, met(number, name, told, 10), merge=ON)
    assert [new(store, tile) for tile in TILES] == [0, 0, 0, 8]
    for number, name in enumerate("cdef"[: len(colluders)], 10):
        take(store, of(number, name, {tile: {} for tile in TILES[:3]}), merge=ON)
    take(store, of(20, "last", {tile: {wall_of(tile)[0]: None} for tile in TILES[:3]}), merge=ON)
    assert [new(store, tile) for tile in TILES] == [0, 0, 0, 0]
    assert {one.vehicle for one in store.lone_words()} == set(colluders)
    assert {one.why for one in store.lone_words()} == {"others deny 144 of 144 claims"}
    assert (LAST, "contradicted") in {(one.tile, one.reason) for one in store.waiting_changes()}
    assert is_verified(store)


def test_nobody_is_quarantined_for_what_others_have_made_a_vote(store: SqliteStore) -> None:
    """An honest vehicle met much of something that moved; a liar tells of the same voxels, many see them empty."""
    take(store, met(1, "honest", everywhere()), merge=ON)
    take(store, met(2, "liar", everywhere(), 19), merge=ON)
    for number, name in enumerate("abcdef", 3):
        take(store, says(number, name, NOTHING), merge=ON)
    take(store, says(9, "judge", {tile: little(tile) for tile in TILES}), merge=ON)
    assert store.quarantined_vehicles() == frozenset()
    assert store.unheard_vehicles() == {}
    assert [new(store, tile) for tile in TILES] == [0] * 4


def test_versions_made_with_it_are_folded_and_computed_anew(store: SqliteStore) -> None:
    few = new_of(LAST)[:4] + new_of(LAST)[24:28]
    for number, name in enumerate("ab", 1):
        take(store, met(number, name, {LAST: few}), merge=ON)
    hours = 10**9 * 3600
    for number, name in enumerate("cdef", 3):
        one = of(number, name, {LAST: {new_of(LAST)[30 + number]: BALL}})
        take(store, one, NS + number * 2 * hours, merge=ON)
    journal = store.in_play("ndt", LAST)
    assert journal.memory is not None
    assert decode_state(LAST, journal.memory).gaussians is not None
    assert is_verified(store)
