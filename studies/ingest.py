"""Real short reports into real shards: how soon they are acknowledged, how many a second, and what each costs."""

import concurrent.futures
import multiprocessing
import os
import random
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import cycle, islice
from pathlib import Path

import numpy as np

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.expander import Expander
from gnd.cloud_merger.ingest import Ingest
from gnd.cloud_merger.merger import run_shard
from gnd.cloud_merger.warm import warm_up
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.router import open_router
from gnd.schemas.changes import ChangeAck
from gnd.schemas.report_states import ReportState
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.report.packing import pack_measured
from studies.frame.measure import Figure, spent_s
from studies.short_corpus import Corpus, CorpusReport, corpus

CLIENTS = 100
SESSIONS = 4
REPORTS = 3_000
PACED_S = 10.0
PACE_HZ = 2.0  # reports a second of each client: a vehicle that drives sends one every 20 s
CHEAP_REPORTS = 1_000
LOOKED_AT = 60


@dataclass(frozen=True, slots=True, eq=False)
class SentUpload:
    """What came of a run: latency of each ack, s, and how long it took altogether."""

    took_s: np.ndarray
    wall_s: float
    acknowledged: int


def run() -> list[Figure]:
    """Measure acks of 100 clients, at the pace of a fleet and as fast as it goes, and what a report costs."""
    reports = corpus()
    return [*_acks(reports, 1), *_acks(reports, 2), *costs(reports)]


def from_many(reports: Sequence[CorpusReport], count: int, name: str) -> list[CorpusReport]:
    """The reports again and again, each time as another vehicle's."""
    return [one.of_vehicle(f"{name}-{n}", n) for n, one in enumerate(islice(cycle(reports), count))]


def _acks(reports: Corpus, shards: int) -> list[Figure]:
    with tempfile.TemporaryDirectory() as folder, _cloud(Path(folder), shards, reports) as connect:
        paced = _send(connect, from_many(reports.reports, int(CLIENTS * PACED_S * PACE_HZ), "paced"), 1.0 / PACE_HZ)
        fast = _send(connect, from_many(reports.reports, REPORTS, "fast"), 0.0)
    which = f"{shards} shard{'s' * (shards > 1)}"
    load = f"load {os.getloadavg()[0]:.1f}"
    detail = f"{CLIENTS} clients, {CLIENTS * PACE_HZ:.0f} reports a second, {paced.acknowledged} acknowledged, {load}"
    closed = f"{CLIENTS} in flight at any time, {fast.acknowledged} of {REPORTS} acknowledged, {load}"
    return [
        Figure(f"ack p50, {which}", 1e3 * float(np.quantile(paced.took_s, 0.5)), "ms", detail),
        Figure(f"ack p99, {which}", 1e3 * float(np.quantile(paced.took_s, 0.99)), "ms", detail),
        Figure(f"reports acknowledged, {which}", fast.acknowledged / fast.wall_s, "1/s", closed),
        Figure(f"ack p50 in flight, {which}", 1e3 * float(np.quantile(fast.took_s, 0.5)), "ms", closed),
        Figure(f"ack p99 in flight, {which}", 1e3 * float(np.quantile(fast.took_s, 0.99)), "ms", closed),
    ]


def _send(connect: str, reports: Sequence[CorpusReport], pause_s: float) -> SentUpload:
    """Every client sends its share, one after the other, `pause_s` apart (0: at once)."""
    letters = [(one.key, one.packed.encode()) for one in reports]
    buses = [open_bus(BusConfig(connect=(connect,)), name=f"client-{n}") for n in range(SESSIONS)]

    def client(number: int) -> list[tuple[float, bool]]:
        rng, found = random.Random(number), []
        for key, payload in letters[number::CLIENTS]:
            began_s = time.perf_counter()
            found.append(_one(buses[number % SESSIONS], key, payload))
            if pause_s:
                time.sleep(max(0.0, pause_s * rng.uniform(0.5, 1.5) - (time.perf_counter() - began_s)))
        return found

    start_s = time.perf_counter()
    with concurrent.futures.ThreadPoolExecutor(CLIENTS) as pool:
        outcomes = [one for found in pool.map(client, range(CLIENTS)) for one in found]
    wall_s = time.perf_counter() - start_s
    for bus in buses:
        bus.close()
    return SentUpload(np.array([took_s for took_s, _ in outcomes]), wall_s, sum(good for _, good in outcomes))


def _one(bus: Bus, key: str, payload: bytes) -> tuple[float, bool]:
    start_s = time.perf_counter()
    status = ChangeAck.decode(bus.request(key, payload, kind="change", timeout_s=120.0)).status
    return time.perf_counter() - start_s, status == "stored"


def costs(reports: Corpus) -> list[Figure]:
    """CPU of this process for each report, to the ack and to the journal, without a bus."""
    warm_up()
    with tempfile.TemporaryDirectory() as folder, SqliteStore(Path(folder) / "store.sqlite") as store:
        store.put_tiles(reports.tiles())
        states: list[ReportState] = []
        ingest = Ingest(store, "bench")
        expander = Expander(store, ShardConfig("bench"), lambda _, state: states.append(state))
        many = from_many(reports.reports, CHEAP_REPORTS, "cheap")
        letters = [(one.key, one.packed.encode()) for one in many]
        to_ack = 1e3 * spent_s(lambda: _in_threads(lambda letter: ingest.answer(*letter), letters)) / len(letters)
        flags = 1e3 * spent_s(lambda: _work(expander, LOOKED_AT)) / LOOKED_AT
    size = f"{np.mean([len(payload) for _, payload in letters]):.0f} B each"
    return [
        Figure("CPU to the ack", to_ack, "ms/report", f"{len(letters)} first halves of {size}, 16 threads, no bus"),
        Figure("CPU from flags to the journal", flags, "ms/report", f"{LOOKED_AT} of them"),
        Figure("CPU from Gaussians to the journal", _second_halves(reports), "ms/report", f"{LOOKED_AT} second halves"),
    ]


def _second_halves(reports: Corpus) -> float:
    """CPU a second half, ms, of reports of which any Gaussians are wanted."""
    with tempfile.TemporaryDirectory() as folder, SqliteStore(Path(folder) / "store.sqlite") as store:
        store.put_tiles(reports.tiles())
        states: dict[str, bytes] = {}
        ingest = Ingest(store, "bench")
        expander = Expander(
            store, ShardConfig("bench"), lambda _, state: states.update({state.report_id: state.wanted})
        )
        many = from_many(reports.reports, LOOKED_AT, "halves")
        for one in many:
            ingest.answer(one.key, one.packed.encode())
        while expander.work():
            pass
        asked = [one for one in many if states[one.packed.report_id]]
        for one in asked:
            half = pack_measured(one.whole, reports.bases(), states[one.packed.report_id])
            ingest.answer(one.key, half.encode())
        return 1e3 * spent_s(lambda: _work(expander, len(asked))) / max(len(asked), 1)


def _work(expander: Expander, least: int) -> None:
    done = 0
    while done < least:
        done += expander.work()


def _in_threads(work: Callable[[tuple[str, bytes]], object], letters: Sequence[tuple[str, bytes]]) -> None:
    with concurrent.futures.ThreadPoolExecutor(16) as pool:
        list(pool.map(work, letters))


@contextmanager
def _cloud(folder: Path, shards: int, reports: Corpus) -> Iterator[str]:
    connect = f"tcp/127.0.0.1:{_free_port()}"
    with SqliteStore(folder / "store.sqlite") as store:
        store.put_tiles(reports.tiles())
    context = multiprocessing.get_context("spawn")
    with open_router((connect,)):
        processes = [
            context.Process(target=_shard, args=(ShardConfig(f"shard-{n}", folder / "store.sqlite", (connect,)),))
            for n in range(shards)
        ]
        for process in processes:
            process.start()
        _send(connect, from_many(reports.reports, CLIENTS, "probe"), 0.0)  # all districts are declared then
        try:
            yield connect
        finally:
            for process in processes:
                process.terminate()
                process.join()


def _shard(config: ShardConfig) -> None:
    run_shard(config, threading.Event())


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
