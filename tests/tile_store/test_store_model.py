"""The store against a plain model of it: random histories of two mergers, vehicles and an operator, step by step."""

from collections.abc import Callable
from dataclasses import dataclass, field

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule, run_state_machine_as_test
from store_helpers import EAGER, EAST, TILE, Clock, Maker, SqliteMaker, basis_of, report, report_id, tile_of_voxels

from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.errors import UnknownVersion
from gnd.tile_store.values import Publication, TileWork

LEASE_S = 10.0
TILES = st.sampled_from([TILE, EAST])
OWNERS = st.sampled_from(["m1", "m2"])


@dataclass
class ModelTile:
    """One tile as the promises describe it: the content of each version, and for each report when it was merged."""

    contents: list[frozenset[int]] = field(default_factory=list)
    epoch: int = 0
    merged_in: dict[int, int | None] = field(default_factory=dict)
    arrivals: int = 0
    is_dirty: bool = False
    lease: tuple[str, int] | None = None
    """Owner, end of the lease."""

    @property
    def version(self) -> int:
        return len(self.contents)

    def counting(self) -> list[int]:
        """The reports that count since the epoch."""
        return sorted(n for n, merged in self.merged_in.items() if merged is None or merged >= self.epoch)


@dataclass
class Held:
    """Work that a merger has loaded, and how the tile stood then."""

    work: TileWork
    arrivals: int
    is_current: bool = True


def merged(tile: ModelTile) -> frozenset[int]:
    """What a merge makes of a tile: the epoch's voxels, and one for each report that counts (9 changes nothing)."""
    epoch = tile.contents[tile.epoch - 1] if tile.epoch else frozenset()
    return epoch | {n for n in tile.counting() if n != 9}


class StoreMachine(RuleBasedStateMachine):
    """Every rule acts on the store and on the model; the invariants compare the two."""

    def __init__(self, maker: Maker) -> None:
        super().__init__()
        self.clock = Clock()
        self.maker = maker
        self.store = self.maker.open(EAGER, self.clock)
        self.tiles = {TILE: ModelTile(), EAST: ModelTile()}
        self.held: list[Held] = []

    def teardown(self) -> None:
        try:
            self.merge_the_rest()
        finally:
            self.store.close()

    def merge_the_rest(self) -> None:
        """Whatever has happened: when all is merged, the map is a function of the epochs and the reports that count."""
        self.clock.advance(LEASE_S)
        for claim in self.store.claim("last", 10, LEASE_S):
            voxels = merged(self.tiles[claim.tile])
            version = self.tiles[claim.tile].version
            self.store.publish([Publication(claim, version, tile_of_voxels(claim.tile, *voxels))])
        assert self.store.dirty_count() == 0
        for tile, model in self.tiles.items():
            head = self.store.get("ndt", tile)
            assert (head.sha if head else None) == (tile_of_voxels(tile, *merged(model)).sha if head else None)
            assert head is not None or not model.merged_in

    @rule(tile=TILES, numbers=st.sets(st.integers(0, 9), min_size=1, max_size=3))
    def reports_arrive(self, tile: TileId, numbers: set[int]) -> None:
        model = self.tiles[tile]
        new = sorted(numbers - model.merged_in.keys())
        statuses = self.store.put_reports([report(number, tile) for number in sorted(numbers)])
        assert statuses == ["stored" if number in new else "duplicate" for number in sorted(numbers)]
        for number in new:
            model.merged_in[number] = None
            model.arrivals += 1
            model.is_dirty = True

    def claim_and_load(self, owner: str) -> None:
        free = {
            tile
            for tile, model in self.tiles.items()
            if model.is_dirty and (model.lease is None or model.lease[1] <= self.clock.ns)
        }
        claims = self.store.claim(owner, 10, LEASE_S)
        assert {claim.tile for claim in claims} == free
        for claim in claims:
            self._drop_holds(claim.tile)
            model = self.tiles[claim.tile]
            model.lease = (owner, self.clock.ns + round(LEASE_S * 1e9))
            work = self.store.load(claim)
            assert [row.report_id for row in work.reports] == [report_id(n) for n in model.counting()]
            assert work.base_version == model.version
            self.held.append(Held(work, model.arrivals))

    @precondition(lambda self: any(model.is_dirty for model in self.tiles.values()))
    @rule(owner=OWNERS)
    def a_merger_claims_and_loads(self, owner: str) -> None:
        self.claim_and_load(owner)

    @precondition(lambda self: self.held)
    @rule(owner=OWNERS)
    def leases_run_out_and_another_claims(self, owner: str) -> None:
        self.clock.advance(LEASE_S)
        self.claim_and_load(owner)

    @precondition(lambda self: self.held)
    @rule(data=st.data())
    def a_merger_publishes(self, data: st.DataObject) -> None:
        held = data.draw(st.sampled_from(self.held))
        self.held.remove(held)
        tile, model = held.work.claim.tile, self.tiles[held.work.claim.tile]
        epoch = held.work.epoch.decode().gaussians.voxel_id.tolist() if held.work.epoch else []
        numbers = {int(row.received_ns % 1000) for row in held.work.reports}
        content = tile_of_voxels(tile, *epoch, *(numbers - {9}))
        ids = tuple(row.report_id for row in held.work.reports)
        one = Publication(held.work.claim, held.work.base_version, content, report_ids=ids, basis=basis_of(held.work))
        (result,) = self.store.publish([one])
        if not held.is_current or held.work.base_version != model.version:
            assert (result.status, result.version) == ("stale", model.version)
            if held.is_current:
                model.lease = None
            return
        voxels = frozenset(epoch) | (numbers - {9})
        head = model.contents[-1] if model.contents else None
        if voxels == head:
            assert (result.status, result.version) == ("unchanged", model.version)
        else:
            model.contents.append(voxels)
            assert (result.status, result.version) == ("published", model.version)
        for number in numbers:
            if model.merged_in[number] is None:
                model.merged_in[number] = model.version
        model.is_dirty = model.arrivals != held.arrivals
        model.lease = None

    @rule(owner=OWNERS)
    def a_merger_dies(self, owner: str) -> None:
        held = {tile for tile, model in self.tiles.items() if model.lease and model.lease[0] == owner}
        assert self.store.release(owner) == len(held)
        for tile in held:
            self.tiles[tile].lease = None
            self._drop_holds(tile)

    @rule(tile=TILES, voxels=st.frozensets(st.integers(20, 23), max_size=2))
    def a_map_is_imported(self, tile: TileId, voxels: frozenset[int]) -> None:
        model = self.tiles[tile]
        same = model.version > 0 and model.epoch == model.version and model.contents[-1] == voxels
        (result,) = self.store.put_tiles([tile_of_voxels(tile, *voxels)])
        if not same:
            model.contents.append(voxels)
            model.epoch = model.version
        assert (result.status, result.version) == ("unchanged" if same else "published", model.version)

    @rule(tile=TILES, version=st.integers(1, 5))
    def an_operator_rolls_back(self, tile: TileId, version: int) -> None:
        model = self.tiles[tile]
        try:
            stored = self.store.rollback("ndt", tile, version)
        except UnknownVersion:
            assert version > model.version
            return
        model.contents.append(model.contents[version - 1])
        model.epoch = model.version
        assert stored.version == model.version

    @rule()
    def the_process_is_started_again(self) -> None:
        self.store.close()
        self.store = self.maker.open(EAGER, self.clock)

    @invariant()
    def store_and_model_agree(self) -> None:
        heads = {entry.tile: entry.version for entry in self.store.heads()}
        assert heads == {tile: model.version for tile, model in self.tiles.items() if model.version}
        assert self.store.dirty_count() == sum(model.is_dirty for model in self.tiles.values())
        waiting = sum(merged is None for model in self.tiles.values() for merged in model.merged_in.values())
        assert self.store.counts().waiting == waiting
        for tile, model in self.tiles.items():
            for version, voxels in enumerate(model.contents, 1):
                stored = self.store.get("ndt", tile, version=version)
                assert stored is not None
                assert stored.sha == tile_of_voxels(tile, *voxels).sha

    def _drop_holds(self, tile: TileId) -> None:
        """Whoever held the tile's lease before has lost it."""
        for held in self.held:
            if held.work.claim.tile == tile:
                held.is_current = False


@pytest.mark.slow
def test_store_and_model_agree(new_maker: Callable[[], Maker]) -> None:
    is_file = isinstance(new_maker(), SqliteMaker)
    tried = settings(
        max_examples=50 if is_file else 12,
        stateful_step_count=50,
        deadline=None,
        suppress_health_check=[HealthCheck.too_slow],
    )
    run_state_machine_as_test(lambda: StoreMachine(new_maker()), settings=tried)
