"""The checks of a chaos run are given what they must find: they may not be able to pass without looking."""

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path

import apsw
import numpy as np
import pytest

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.expander import Expander
from gnd.cloud_merger.ingest import Ingest
from gnd.cloud_merger.work import Worker
from gnd.deploy.chaos.checks import Findings, look
from gnd.deploy.chaos.clients import Receipt, put
from gnd.deploy.chaos.street import LAYER, ChaosStreet, SentReport, read_street
from gnd.gnd_map.codec import encode_mask
from gnd.schemas.report_id import deterministic_report_id
from gnd.schemas.report_states import ReportState
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoreConfig
from gnd.vehicle_agent.link.outbox import Outbox
from gnd.vehicle_agent.report.packing import askable, pack_measured

Verify = Callable[[Path], tuple[dict[str, int], bool]]
SEED, VEHICLES, REPORTS = 5, ("car-0", "car-1"), 3


@pytest.fixture(scope="module")
def street() -> ChaosStreet:
    return read_street(districts=1)


@dataclasses.dataclass
class World:
    """A small cloud that has ended, and what its clients hold; the tests break it before it is looked at."""

    folder: Path
    sent: list[SentReport]

    @property
    def store(self) -> Path:
        return self.folder / "store.sqlite"

    @property
    def receipts(self) -> Path:
        return self.folder / "follower.jsonl"

    def look(self, verify: Verify | None = lambda _store: ({"same": 1}, True)) -> Findings:
        """All that is found; whether the map is what the journal gives only where a test is about that."""
        return look(self.store, sorted(self.folder.glob("car-*.sqlite")), [self.receipts], verify)

    def run(self, statement: str) -> None:
        connection = apsw.Connection(str(self.store))
        connection.execute(statement)
        connection.close()


@pytest.fixture(scope="module")
def whole_world(tmp_path_factory: pytest.TempPathFactory, street: ChaosStreet) -> World:
    """Every report acknowledged, halves asked for and sent, all merged, and received by a follower."""
    tmp_path = tmp_path_factory.mktemp("whole")
    sent = [street.said(SEED, vehicle, n) for vehicle in VEHICLES for n in range(REPORTS)]
    assert any(askable(one.whole) for one in sent)
    outboxes = {vehicle: Outbox(tmp_path / f"{vehicle}.sqlite") for vehicle in VEHICLES}
    config = ShardConfig(store=StoreConfig(merge_delay_s=0.0))
    with SqliteStore(tmp_path / "store.sqlite", config.store) as store:
        store.put_tiles(street.tiles)
        wanted: dict[str, bytes] = {}
        ingest = Ingest(store, config.shard_id)
        expander = Expander(store, config, lambda _, state: wanted.update({state.report_id: state.wanted}))
        for one in sent:
            outbox, report_id = outboxes[one.whole.vehicle], one.whole.report_id
            put(outbox, one)
            assert ingest.answer(one.key, one.packed.encode()).status == "stored"
            outbox.answered(report_id, "stored")
            expander.work()
            if wanted.get(report_id):
                outbox.told(ReportState(report_id, "wanted", wanted[report_id]), 0)
                half = pack_measured(one.whole, one.bases_by_sha, wanted[report_id])
                assert ingest.answer(one.key, half.encode()).status == "stored"
                outbox.answered(report_id, "stored", wanted=wanted[report_id], is_short=True)
                expander.work()
            outbox.told(ReportState(report_id, "released"), 0)
        worker = Worker(store, config)
        while claims := store.claim("one", 16, 30.0):
            for claim in claims:
                worker.settle(claim)
        store.announced(store.notices())
        lines = []
        for head in store.heads(LAYER):
            tile = store.get(LAYER, head.tile)
            assert tile is not None
            lines.append(Receipt(head.tile, head.version, head.sha, tile.decode().sha, "blob").line())
        (tmp_path / "follower.jsonl").write_text("".join(lines))
    for outbox in outboxes.values():
        outbox.close()
    return World(tmp_path, sent)


@pytest.fixture
def world(whole_world: World, tmp_path: Path) -> World:
    """One to be broken."""
    shutil.copytree(whole_world.folder, tmp_path / "world")
    return World(tmp_path / "world", whole_world.sent)


def test_a_cloud_that_kept_its_word_has_nothing_found(world: World) -> None:
    found = world.look(verify=None)
    assert found.failures == []
    assert (found.acknowledged, found.reports) == (6, 6)
    assert min(found.versions, found.received, found.verify["same"]) > 0


LOSSES: dict[str, Callable[[World], None]] = {
    "a tile of it": lambda world: world.run("DELETE FROM report WHERE arrival = (SELECT min(arrival) FROM report)"),
    "its Gaussians": lambda world: world.run("DELETE FROM report WHERE part = 1"),
    "all": lambda world: world.run(f"DELETE FROM report WHERE report_id = '{world.sent[0].whole.report_id}'"),
}


@pytest.mark.parametrize("what", LOSSES)
def test_what_is_lost_is_found(world: World, what: str) -> None:
    LOSSES[what](world)
    found = world.look()
    assert found.lost
    assert any("lost" in one for one in found.failures)


def test_a_report_that_was_changed_on_its_way_is_lost(world: World, street: ChaosStreet) -> None:
    one = next(one for one in world.sent if any(len(change.changed) for change in one.whole.tiles))
    at = next(k for k, change in enumerate(one.whole.tiles) if len(change.changed))
    tiles = list(one.whole.tiles)
    rows = np.arange(1, len(tiles[at].changed))
    tiles[at] = dataclasses.replace(
        tiles[at],
        changed=tiles[at].changed.take(rows),
        change_class=tiles[at].change_class[rows],
        evidence=tiles[at].evidence[rows],
    )
    # the vehicle holds a report with a voxel less than the journal
    path = world.folder / f"{one.whole.vehicle}.sqlite"
    connection = apsw.Connection(str(path))
    body = dataclasses.replace(one.whole, tiles=tuple(tiles)).encode()
    connection.execute("UPDATE report SET body = ? WHERE report_id = ?", (body, one.whole.report_id))
    connection.close()
    assert ["something else" in line for line in world.look().lost] == [True]


def test_a_report_that_is_in_the_journal_twice_is_found_whatever_its_id(world: World) -> None:
    whole = world.sent[0].whole
    other = dataclasses.replace(whole, report_id=deterministic_report_id(1, "another"))
    with SqliteStore(world.store) as store:
        row = next(row for row in store.reports(LAYER) if row.report_id == whole.report_id)
        first = dataclasses.replace(other, tiles=(other.tiles[0],))
        store.put_reports([dataclasses.replace(row, report_id=other.report_id, body=first.encode())])
    found = world.look()
    assert len(found.doubled) == 1
    assert "2 rows of part 0" in found.doubled[0]
    assert any("doubled" in one for one in found.failures)


def test_a_report_that_nobody_has_sent_is_found(world: World) -> None:
    (world.folder / "car-1.sqlite").unlink()
    assert all("no client has sent it" in line for line in world.look().doubled)
    assert world.look().doubled


@pytest.mark.parametrize("how", ["did not decode", "other content", "no such version"])
def test_a_torn_tile_is_found(world: World, how: str) -> None:
    first = Receipt.of_line(world.receipts.read_text().splitlines()[0])
    torn = {
        "did not decode": dataclasses.replace(first, found_sha=b""),
        "other content": dataclasses.replace(first, sha=b"\1" * 32, found_sha=b"\1" * 32),
        "no such version": dataclasses.replace(first, version=first.version + 40),
    }[how]
    with world.receipts.open("a") as file:
        file.write(torn.line() + '[1, 2, "half a li')
    found = world.look()
    assert len(found.torn_tiles) == 1
    assert any("torn" in one for one in found.failures)


def test_work_that_never_ends_is_found(world: World, street: ChaosStreet) -> None:
    one = next(street.said(SEED, "car-0", n) for n in range(REPORTS, 99))
    with SqliteStore(world.store) as store:
        Ingest(store, "one").answer(one.key, one.packed.encode())
    assert world.look().stuck_tiles == ["1 uploads are waiting"]
    with SqliteStore(world.store) as store:
        Expander(store, ShardConfig("one"), lambda *_: None).work()
    found = world.look()
    assert len(found.stuck_tiles) >= len(one.whole.tiles) / 2
    assert any("stuck" in line for line in found.failures)
    world.run("DELETE FROM dirty")  # the queue has forgotten them
    assert any("in no version" in line for line in world.look().stuck_tiles)


def test_gaussians_without_flags_are_stuck(world: World, street: ChaosStreet) -> None:
    one = next(one for one in (street.said(SEED, "car-9", n) for n in range(99)) if askable(one.whole))
    half = pack_measured(one.whole, one.bases_by_sha, encode_mask(np.ones(askable(one.whole), np.bool_)))
    with SqliteStore(world.store) as store:
        Ingest(store, "one").answer(one.key, half.encode())
        Expander(store, ShardConfig("one"), lambda *_: None).work()
    assert world.look().stuck_tiles == ["1 uploads are early"]


def test_a_map_that_is_not_what_its_journal_gives_is_found(world: World, street: ChaosStreet) -> None:
    world.run(
        "UPDATE tile_version SET (codec_id, body, sha) = (SELECT codec_id, body, sha FROM tile_version AS old WHERE"
        " old.layer = tile_version.layer AND old.tile = tile_version.tile AND old.version = 1) WHERE kind = 'merged'"
    )
    found = world.look(verify=None)
    assert not found.identical_map
    assert found.verify["differs"] > 0
    assert any("verify" in one for one in found.failures)


def test_what_a_client_still_waits_for_and_a_damaged_body_are_found(world: World) -> None:
    path = world.folder / "car-0.sqlite"
    outbox = Outbox(path)
    outbox._db.run("UPDATE report SET state = 'stored'")
    outbox.close()
    world.run("UPDATE tile_version SET body = zeroblob(length(body)) WHERE version = 1 AND length(body) > 3000")
    found = world.look()
    assert len(found.unreleased) == REPORTS
    assert found.damages


def test_a_run_in_which_nothing_happened_has_failed(tmp_path: Path, street: ChaosStreet) -> None:
    with SqliteStore(tmp_path / "store.sqlite") as store:
        store.put_tiles(street.tiles)
        store.announced(store.notices())
    found = look(tmp_path / "store.sqlite", [], [], lambda _store: ({"same": 0}, False))
    assert [one for one in found.failures if "nothing was tested" in one] == [
        f"nothing {name}: nothing was tested" for name in ("acknowledged", "versions", "received")
    ]
