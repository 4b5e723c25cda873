"""One drive under two names is one witness; two drives on one street never look like one."""

import itertools
import lzma
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from merger_world import BALL, change_of, report_id, report_of
from test_agreement import BUILT, GONE, NS, TILES, at, base_of, new_of, observed, shas, take, wall_of
from test_met_trust import new
from test_standing import a_store, changed, is_verified

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.confirmation import ConfirmationParameters
from gnd.cloud_merger.expander import rows_of
from gnd.cloud_merger.groups import COPY_LEAST, copies_of, groups_of, with_copies
from gnd.cloud_merger.statements import STATEMENT, Report, Statements
from gnd.cloud_merger.work import Worker
from gnd.deploy.cli import gnd
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.tile_store.marks import Marked, grouped, over_cap
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import Coincidence

LAST = TILES[3]
HOUR_NS = 3600 * 10**9
NOTHING_BEFORE = Statements((), np.zeros(0, STATEMENT))
FLEET = Path(__file__).parent / "data" / "store_before_hearing.sqlite.xz"


@pytest.fixture
def store(tmp_path: Path) -> Iterable[SqliteStore]:
    with a_store(tmp_path / "map.sqlite") as store:
        yield store


def drive(
    number: int, vehicle: str, claims: Mapping[TileId, Mapping[int, object]], rays: int = 0
) -> list[ChangeReport]:
    """The same measurements whoever sends them; `rays`: seed of how many have passed where something is gone."""
    made = []
    for k, (tile, some) in enumerate(claims.items()):
        change = change_of(base_of(tile), observed(tile), some, tile=tile)  # type: ignore[arg-type]
        if rays:
            evidence = np.random.default_rng(rays).integers(1, 200, change.evidence.shape).astype(np.int32)
            change = replace(change, evidence=evidence)
        made.append(at(number, report_of(100 * number + k, change, vehicle=vehicle)))
    return made


def test_one_drive_under_two_names_is_one_witness_everywhere(store: SqliteStore) -> None:
    """In no version, in the tile where it shows, and where it does not; another vehicle is a second witness."""
    for number, name in enumerate("ab", 1):
        take(store, drive(number, name, {TILES[0]: BUILT[TILES[0]]}))
    assert len(store.history("ndt", TILES[0])) == 1
    assert [one.vehicles for one in groups_of(store)] == [("a", "b")]
    for number, name in enumerate("ab", 3):
        take(store, drive(number, name, {LAST: GONE[LAST]}))
    assert changed(store, LAST) == 0
    take(store, drive(9, "other", {LAST: GONE[LAST]}))
    assert changed(store, LAST) == 48
    assert store.quarantined_vehicles() == frozenset()
    assert is_verified(store)
    run = CliRunner()
    for command in (["list", str(store.path)], ["why", str(store.path), "b"]):
        assert "a, b have sent the same measurements, to the bit, in 48 voxels" in run.invoke(
            gnd, ["vehicles", *command]
        ).output  # fmt: skip


@pytest.mark.parametrize("later_h", [0, 3, 48])
def test_it_does_not_help_to_wait_nor_to_drive_honestly_afterwards(store: SqliteStore, later_h: int) -> None:
    """Each window by itself; others close the windows in between. The word stays one when both are judged again."""
    take(store, drive(1, "a", {LAST: BUILT[LAST]}), NS)
    at_the_wall = change_of(base_of(LAST), wall_of(LAST), {wall_of(LAST)[0]: None}, tile=LAST)
    take(store, [at(2, report_of(200, at_the_wall, vehicle="x"))], NS + later_h * HOUR_NS // 2)
    take(store, drive(3, "b", {LAST: BUILT[LAST]}), NS + later_h * HOUR_NS)
    assert new(store, LAST) == 0
    for number, name in enumerate("abcde", 4):
        take(store, drive(number, name, {LAST: dict.fromkeys(wall_of(LAST)[:24])}), NS + (later_h + 3) * HOUR_NS)
    assert new(store, LAST) == 0
    assert [one.vehicles for one in groups_of(store)] == [("a", "b")]
    assert is_verified(store)


def test_what_is_gone_tells_by_its_rays(store: SqliteStore) -> None:
    for number, name in enumerate("ab", 1):
        take(store, drive(number, name, {LAST: GONE[LAST]}, rays=5))
    assert changed(store, LAST) == 0
    take(store, drive(3, "c", {LAST: GONE[LAST]}, rays=6))
    assert changed(store, LAST) == 48
    assert is_verified(store)


def test_three_names_are_one_and_their_order_decides_nothing(tmp_path: Path) -> None:
    told = [drive(n, name, {LAST: BUILT[LAST]}) for n, name in enumerate("abc", 1)]
    told.append(drive(5, "honest", {LAST: {}}))
    found = set()
    for number, order in enumerate(itertools.islice(itertools.permutations(told), 0, 24, 5)):
        with a_store(tmp_path / f"{number}.sqlite") as store:
            for one in order:
                take(store, one)
            found.add((tuple(shas(store)), tuple(one.vehicles for one in groups_of(store))))
            assert new(store, LAST) == 0
            assert is_verified(store)
    assert {groups for _, groups in found} == {(("a", "b", "c"),)}
    assert len(found) == 1


def test_a_cloud_is_told_to_believe_copies(store: SqliteStore) -> None:
    """As `gnd fleet` is where one recording is driven twice."""
    config = ShardConfig("one", store.path, confirmation=ConfirmationParameters(copies=False))
    for number, name in enumerate("ab", 1):
        for report in drive(number, name, {LAST: BUILT[LAST]}):
            store.put_reports(rows_of(report, NS))
        worker = Worker(store, config)
        while claims := store.claim("one", 4, 30.0):
            worker.settle_some(claims)
    assert new(store, LAST) == 48
    assert groups_of(store) == []
    assert is_verified(store)


# ---- the test by itself


def of(vehicle: str, change: TileChange, number: int = 1) -> Report:
    return Report(report_id(number), change, vehicle=vehicle)


def both(share: float, n: int, seed: int = 0) -> tuple[TileChange, TileChange]:
    """Two reports of n voxels of which a share is the same to the bit."""
    rng = np.random.default_rng(seed)
    ids = new_of(LAST)[:n]
    one = change_of(base_of(LAST), observed(LAST), dict.fromkeys(ids, BALL), tile=LAST)
    mean_m = one.changed.mean_m.copy()
    mean_m[round(share * n) :] += rng.choice([-0.01, 0.01], (n - round(share * n), 3)).astype(np.float32)
    return one, replace(one, changed=replace(one.changed, mean_m=mean_m))


@pytest.mark.parametrize(
    ("share", "n", "is_copy"),
    [(1.0, 48, True), (0.5, 48, True), (0.45, 48, False), (0.1, 48, False), (1.0, COPY_LEAST, True), (1.0, 11, False)],
)
def test_half_of_what_both_measured_and_twelve_voxels(share: float, n: int, is_copy: bool) -> None:
    one, other = both(share, n)
    found = copies_of([of("b", other, 2), of("a", one)], NOTHING_BEFORE)
    assert found == ((Coincidence("a", "b", round(share * n), 0.0, n),) if is_copy else ())
    assert copies_of([of("a", one), of("a", other, 2)], NOTHING_BEFORE) == ()  # its own
    assert copies_of([of("", one), of("", other, 2)], NOTHING_BEFORE) == ()


def test_what_was_not_asked_for_and_what_nobody_measured_says_nothing() -> None:
    flags = change_of(base_of(LAST), observed(LAST), dict.fromkeys(new_of(LAST)), tile=LAST, withheld=new_of(LAST))
    assert copies_of([of("a", flags), of("b", flags, 2)], NOTHING_BEFORE) == ()
    assert copies_of([], NOTHING_BEFORE) == ()


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_any_reports_are_compared_as_one_pair_at_a_time(seed: int) -> None:
    """Whoever has sent what another has is found with it, and nobody else."""
    rng = np.random.default_rng(seed)
    drives = [both(0.0, int(rng.integers(10, 40)), int(rng.integers(1000)))[1] for _ in range(3)]
    told = []
    for k in range(int(rng.integers(1, 9))):
        change = drives[rng.integers(3)]
        keep = rng.random(len(change.changed)) < rng.choice([0.6, 1.0])
        told.append(of(f"car-{rng.integers(5)}", replace(
            change, changed=change.changed.take(keep), change_class=change.change_class[keep],
            evidence=change.evidence[keep]), k))  # fmt: skip
    rows: dict[str, set[tuple[int, bytes]]] = {}
    for one in told:
        mean = one.change.changed.mean_m
        mine = {(int(v), mean[k].tobytes()) for k, v in enumerate(one.change.changed.voxel_id)}
        rows.setdefault(one.vehicle, set()).update(mine)
    pairs = {
        (a, b)
        for a, b in itertools.combinations(sorted(rows), 2)
        if len(rows[a] & rows[b]) >= max(12, 0.5 * len({v for v, _ in rows[a]} & {v for v, _ in rows[b]}))
    }
    found = copies_of(told, NOTHING_BEFORE)
    assert {(one.one, one.other) for one in found} == pairs
    assert copies_of(told[::-1], NOTHING_BEFORE) == found


def test_two_simulated_vehicles_on_one_street_are_never_taken_for_one(tmp_path: Path) -> None:
    """Eight of `gnd fleet`, in short, two by two in two tiles: less than a fifth of what both measured is the same to
    the bit. One of them under another name is found.
    """
    path = tmp_path / "map.sqlite"
    path.write_bytes(lzma.decompress(FLEET.read_bytes()))
    n_pairs = 0
    with SqliteStore(path) as store:
        for head in store.heads("ndt"):
            rows = store.reports_of_windows("ndt", head.tile, 0, 1 << 40, 1 << 40)
            told = [Report(row.report_id, ChangeReport.decode(row.body).tiles[0], vehicle=row.vehicle) for row in rows]
            assert copies_of(told, NOTHING_BEFORE) == ()
            by_vehicle = {one.vehicle: one for one in told if one.change.changed.exists.sum() >= COPY_LEAST}
            for one, other in itertools.combinations(by_vehicle.values(), 2):
                same, both_have = alike(one.change, other.change)
                n_pairs += both_have >= COPY_LEAST
                assert same <= 0.2 * both_have + 2
            for one in by_vehicle.values():
                (found,) = copies_of([*told, replace(one, vehicle="~twice", report_id=report_id(1))], NOTHING_BEFORE)
                assert {found.one, found.other} == {one.vehicle, "~twice"}
    assert n_pairs >= 10


def alike(one: TileChange, other: TileChange) -> tuple[int, int]:
    """Of how many voxels both have measured the same, and any."""
    ids = np.intersect1d(*(each.changed.voxel_id[each.changed.exists] for each in (one, other)))
    a, b = (each.changed.select(ids) for each in (one, other))
    return int(((a.mean_m == b.mean_m).all(axis=1) & (a.cov_m2 == b.cov_m2).all(axis=1)).sum()), len(ids)


def test_words_about_copies_join_what_is_known() -> None:
    copy = Coincidence("b", "c", 30, 0.0, 30)
    named = frozenset({"shifted", over_cap("c", 3), grouped("a", "a"), grouped("b", "a")})
    joined = with_copies(named, [copy])
    assert Marked.of(joined).first_of == {"a": "a", "b": "a", "c": "a"}
    assert {"shifted", over_cap("c", 3)} <= joined
    assert with_copies(joined, [copy]) == joined
    for other in (replace(copy, by_chance=1.0), replace(copy, shared=23)):
        assert with_copies(named, [other]) == named


def test_a_wall_that_two_measure_apart_is_published(store: SqliteStore) -> None:
    take(store, drive(1, "a", {LAST: BUILT[LAST]}))
    take(store, drive(2, "b", {LAST: dict.fromkeys(new_of(LAST), (0.02, 0.0, *BALL[2:]))}))
    assert new(store, LAST) == 48
