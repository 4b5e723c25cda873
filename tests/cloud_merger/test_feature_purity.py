"""The same reports give the same features, bit for bit, in any order, batching and repetition; one vehicle nothing."""

import itertools

import numpy as np
import pytest
from feature_cloud import (
    ABSENT,
    EAST,
    EXIST,
    TILE,
    change,
    feature,
    found,
    line,
    merge,
    published,
    report,
    seen,
    sha_of,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.features import FeatureMergeParameters
from gnd.cloud_merger.features.existence import pooled
from gnd.cloud_merger.features.kept import FeatureInbox
from gnd.cloud_merger.work import Worker
from gnd.gnd_map.features import Existence, FeatureTile
from gnd.schemas.features import EVERY_CELL
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoreConfig

MAP = published([feature(7, -5.0, 3.0), feature(9, 6.0, -2.0)])
OLDER = published([feature(7, -5.0, 3.0), feature(8, 0.0, 0.0)])
SPOTS = [(0.0, 0.0), (0.4, 0.1), (3.0, 3.0), (-4.8, 3.1), (-5.0, 5.5), (6.0, -2.0)]
LINES = [line((-10.0, 0.0), (10.0, 0.2)), line((-6.0, 0.1), (6.0, 0.1)), line((-10.0, 3.5), (10.0, 3.5))]


@st.composite
def changes(draw):
    said = []
    base = draw(st.sampled_from([MAP, OLDER, None]))
    for one in base or ():
        if draw(st.booleans()):
            place = draw(st.sampled_from([None, *SPOTS]))
            said.append(seen(one.feature_id, draw(st.sampled_from([EXIST, ABSENT])), place, 0.2))
    for spot in draw(st.lists(st.sampled_from(SPOTS), max_size=3, unique=True)):
        shift = draw(st.floats(-0.5, 0.5, width=16))
        sigma_m = draw(st.sampled_from([0.1, 0.5, 2.0]))
        height_m2 = draw(st.sampled_from([0.04, 1e4]))
        said.append(found(spot[0] + shift, spot[1], sigma_m=sigma_m, height_m2=height_m2))
    said += draw(st.lists(st.sampled_from(LINES), max_size=1))
    return change(*said, base=base, viewed=draw(st.sampled_from([0, EVERY_CELL, 0xF0F0F0F0F0F0F0F0])))


def numbered(some, vehicles):
    return [report(n, one, vehicle=f"car-{v}") for n, (one, v) in enumerate(zip(some, vehicles, strict=False))]


@settings(max_examples=50, deadline=None)
@given(st.lists(changes(), max_size=8), st.lists(st.integers(0, 4), min_size=8, max_size=8), st.randoms())
def test_neither_order_nor_repetition_matters(some, vehicles, shuffler):
    reports = numbered(some, vehicles)
    once = merge(MAP, reports)
    shuffled = [*reports, *reports[:3]]
    shuffler.shuffle(shuffled)
    assert merge(MAP, shuffled) == once


@settings(max_examples=50, deadline=None)
@given(st.lists(changes(), min_size=1, max_size=12))
def test_one_vehicle_alone_changes_nothing(some):
    merged = merge(MAP, numbered(some, itertools.repeat(1)))
    assert merged.features == MAP
    assert merged.provenance == {}


def test_nor_does_it_with_a_thousand_reports():
    everything = change(
        seen(7, ABSENT), seen(9, EXIST, (3.0, 3.0)), found(0.0, 0.0), LINES[0], base=MAP, viewed=EVERY_CELL
    )
    reports = [report(n, everything, vehicle="car") for n in range(1000)]
    assert merge(MAP, reports).features == MAP


@settings(max_examples=25, deadline=None)
@given(st.lists(changes(), min_size=2, max_size=6), st.lists(changes(), min_size=1, max_size=6))
def test_one_more_vehicle_publishes_nothing_that_nobody_else_has_found(some, more):
    others = numbered(some, itertools.cycle(range(3)))
    before = merge((), others)
    after = merge((), [*others, *(report(100 + n, one, vehicle="car") for n, one in enumerate(more))])
    fresh = {one.feature_id for one in after.features} - {one.feature_id for one in before.features}
    by_others = {one.report_id for one in others}
    assert all(by_others.intersection(after.provenance[feature_id]) for feature_id in fresh)


@pytest.mark.parametrize("seed", range(3))
def test_whatever_the_batches_the_store_ends_with_the_same_bytes(tmp_path, seed):
    """Through the store, as ingest keeps them: merged one by one, or in batches in any order of arrival."""
    rng = np.random.default_rng([15, seed])
    reports = [report(n, *some_tiles(rng), vehicle=f"car-{rng.integers(5)}") for n in range(24)]
    heads = [
        through_store(tmp_path / f"{k}.sqlite", batches)
        for k, batches in enumerate(([[one] for one in reports], [reports], shuffled_batches(reports, rng)))
    ]
    assert heads[0] == heads[1] == heads[2]
    assert all(version > 0 for version in heads[0].values())


def some_tiles(rng):
    spot = np.array(SPOTS)[rng.integers(len(SPOTS))]
    at = spot + rng.normal(0, 0.3, 2)
    here = change(
        seen(7, (EXIST, ABSENT)[rng.integers(2)], tuple(at) if rng.random() < 0.5 else None),
        found(*(at + rng.normal(0, 2.0, 2))),
        base=MAP,
        viewed=EVERY_CELL if rng.random() < 0.3 else 0,
    )
    beyond = change(found(-14.0 + abs(rng.normal(0, 1.0)), 0.0, sigma_m=1.0), tile=EAST)
    return (here, beyond)[: 1 + int(rng.integers(2))]


def shuffled_batches(reports, rng):
    order = rng.permutation(len(reports))
    return [[reports[i] for i in part] for part in np.array_split(order, 5)]


def through_store(path, batches):
    with SqliteStore(path, StoreConfig(merge_delay_s=0.0)) as store:
        store.put_tiles([FeatureTile.of(TILE, 1, MAP)], layer="signs")
        worker = Worker(store, ShardConfig(store_path=path))
        inbox = FeatureInbox(store, FeatureMergeParameters(), (), reach_tiles=3)
        for batch in batches:
            store.put_reports([row for one in batch for row in inbox.rows(one, 0)])
            while claims := store.claim("one", 16, 30.0):
                store.publish(worker.merge(claims))
        assert store.quarantined() == []
        return {head.sha: head.version > 0 for head in store.heads("signs")}


def plain_dempster(a, b):
    """SLAMCU, Eq. (6)-(7), over the power set of {∃, ∄} written as sets."""
    exist, absent = frozenset("e"), frozenset("a")
    both = exist | absent
    m = dict.fromkeys((exist, absent, both), 0.0)
    empty = 0.0
    for (B, p), (C, q) in itertools.product(a.items(), b.items()):
        if B & C:
            m[B & C] += p * q
        else:
            empty += p * q
    return {s: mass / (1.0 - empty) for s, mass in m.items()}, empty


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.floats(0, 0.95), st.floats(0, 0.95)).filter(lambda m: sum(m) <= 0.95), max_size=8))
def test_masses_of_all_vehicles_at_once_are_those_of_dempster_one_by_one(masses):
    bodies = [Existence(e, a, 1.0 - e - a) for e, a in masses]
    got = pooled(bodies)
    state, agreed = {frozenset("e"): 0.0, frozenset("a"): 0.0, frozenset("ea"): 1.0}, 1.0
    for one in bodies:
        said = {frozenset("e"): one.exist, frozenset("a"): one.absent, frozenset("ea"): one.unknown}
        state, empty = plain_dempster(state, said)
        agreed *= 1.0 - empty
    assert got.exist == pytest.approx(state[frozenset("e")], abs=1e-9)
    assert got.absent == pytest.approx(state[frozenset("a")], abs=1e-9)
    assert got.unknown == pytest.approx(state[frozenset("ea")], abs=1e-9)
    assert got.conflict == pytest.approx(1.0 - agreed, abs=1e-9)


def test_the_maps_have_versions_of_their_own():
    assert len({sha_of(MAP), sha_of(OLDER)}) == 2
