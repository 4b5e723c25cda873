"""The cloud's half of the loop: reports come in, tiles are merged, versions go out."""

import logging
import threading
from collections.abc import Sequence
from contextlib import ExitStack
from typing import Final

from gnd.cloud_merger.admission import Admission
from gnd.cloud_merger.announce import Announcer
from gnd.cloud_merger.catalog_signer import signing_catalogs
from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.expander import Expander
from gnd.cloud_merger.expander_threads import working
from gnd.cloud_merger.ingest import Ingest
from gnd.cloud_merger.leases import Leases
from gnd.cloud_merger.metrics import ShardMetrics
from gnd.cloud_merger.ownership import KnownDistricts, KnownShards, Members, following
from gnd.cloud_merger.patience import PatientWords
from gnd.cloud_merger.reception import Reception
from gnd.cloud_merger.release.collector import HealthCollector
from gnd.cloud_merger.release.keeper import KEEP_EVERY_S, ReleaseKeeper
from gnd.cloud_merger.states import States
from gnd.cloud_merger.stored import Bases
from gnd.cloud_merger.survey.mapper import RoadMapper
from gnd.cloud_merger.warming import warmed_up
from gnd.cloud_merger.work import Worker, in_turn
from gnd.cloud_merger.worker_process import Address, Tell, worker_process
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.certificate_metrics import certificate_checks, register_certificate
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.health import HealthServer
from gnd.fleet_bus.identity.following import follow_revoked
from gnd.fleet_bus.refusals import RefusalsTold, show_refusals
from gnd.tile_store.districts import KnownOwners
from gnd.tile_store.errors import StoreClosed, StoreError
from gnd.tile_store.location import open_store
from gnd.tile_store.metrics import store_checks
from gnd.tile_store.moving import moved_to
from gnd.tile_store.signing import Signing
from gnd.tile_store.values import Claim

__all__ = ["ShardConfig", "run_shard", "run_worker"]
STORE_RETRY_S: Final = 1.0
ANNOUNCE_AT_ONCE: Final = 256
"""Notices for at most so many versions are published in one round."""
TILES_AT_ONCE: Final = 16
"""Tiles that are claimed together; each is published as soon as it is merged."""
ANNOUNCE_EVERY_S: Final = 0.05
ROADS_EVERY_S: Final = 1.0
"""Parts of surveys are looked for so often."""
_EXPANDERS: Final = 2
"""Threads that look at what was acknowledged."""
_LOG = logging.getLogger(__name__)


def run_shard(config: ShardConfig, stop: threading.Event, metrics_at: Address | None = None) -> None:
    """Run one merger shard until `stop` is set: this process receives and acknowledges, its worker does the rest.

    Any number of shards may share a store. What one leaves undone, when it ends or is killed, another does.

    Args:
        config: its settings.
        stop: ends it.
        metrics_at: host and port at which its worker shows metrics and health; None: nowhere.

    Raises:
        StoreError: the store cannot be opened.
    """
    bus_config = BusConfig(connect=config.connect, lease_ms=config.bus_lease_ms, patient=True)
    with (
        open_store(config.store_path, config.store, create=False) as store,
        open_bus(bus_config, name=config.shard_id) as bus,
    ):
        store.release(config.shard_id)  # leases of an earlier life
        words = PatientWords()
        states = States(store, bus, words)
        with worker_process(config, states.tell, metrics_at) as worker:
            admission = Admission(store, names_cost=bus.certificate is not None)
            # look at the outside, keep the bytes
            ingest = Ingest(store, config.shard_id, on_stored=worker.wake, admission=admission, words=words)
            owners = KnownOwners(store)
            members = Members(config.shard_id, KnownDistricts(store), owners)
            follow_revoked(bus)
            states.open(are_several=owners().are_several)
            reception = Reception(bus, members, ingest.answer, store.release, KnownShards(store).has)
            reception.open()
            _LOG.info("merger %s: store %s, mode %s", config.shard_id, store.location, config.merge.mode)
            told = RefusalsTold(_LOG)
            while not stop.wait(config.poll_s):
                reception.look_again()
                states.tell_kept()
                states.open(are_several=owners().are_several)
                told.tell()
                if worker.has_ended():
                    store.release(config.shard_id)  # what it had in hand need not wait for the ends of its leases
                    worker.restart()
            if moved_to(store) is not None:
                worker.give_up()
        store.release(config.shard_id)


def run_worker(
    config: ShardConfig,
    stop: threading.Event,
    arrived: threading.Event,
    tell: Tell,
    metrics_at: Address | None = None,
) -> None:
    """Expand, merge and announce until `stop` is set; `arrived` is set when something has come.

    `tell` is called with a vehicle and how far its report has come, in any thread.

    A store that fails (a full disk, another process that holds it for too long) is tried again until it works.

    Raises:
        StoreError: the store cannot be opened.
        IdentityError: the identity of this process is no shard's.
    """
    signing = Signing.of_environment()
    # or the first tile and the first report would wait for the kernels, and their leases with them
    warmed_up(config.shard_id, metrics_at)
    bus_config = BusConfig(connect=config.connect, lease_ms=config.bus_lease_ms, patient=True)
    with (
        open_store(config.store_path, config.store, create=False, signing=signing) as store,
        open_bus(bus_config, name=f"{config.shard_id}-worker") as bus,
        Leases(store, config.shard_id, config.lease_s) as leases,
        ExitStack() as stack,
    ):
        metrics = ShardMetrics()
        show_refusals(metrics.registry)
        if metrics_at is not None:
            host, port = metrics_at
            register_certificate(metrics.registry, bus.certificate)
            checks = {**store_checks(store, bus), **certificate_checks(bus.certificate)}
            stack.enter_context(HealthServer(port, metrics.registry, checks, host=host))
        members, wake = following(bus, config.shard_id, KnownDistricts(store), KnownOwners(store)), threading.Event()

        # Expand: what was acknowledged becomes reports of tiles, and vehicles hear what is wanted; in threads.
        bases = Bases(store)  # what one has decoded or made, the others need next
        # tiles that wait for longer than the pause between two looks are found in time without being woken for
        on_journaled = wake.set if config.store.merge_delay_s <= config.poll_s else lambda: None
        expander = Expander(store, config, tell, on_journaled=on_journaled, bases=bases)
        stack.enter_context(working(expander.work, arrived, _EXPANDERS, config.poll_s))
        metrics.show_served(expander.served)
        roads = RoadMapper(store, config.shard_id, on_published=wake.set, codec=config.codec)
        stack.enter_context(working(roads.work, threading.Event(), 1, ROADS_EVERY_S))  # surveys -> new roads

        # Release: what vehicles tell of versions on trial decides who gets them next.
        HealthCollector(store).open(bus)
        keeper = ReleaseKeeper(store, members)
        stack.enter_context(working(keeper.work, threading.Event(), 1, KEEP_EVERY_S))
        stack.enter_context(signing_catalogs(store, members, signing))

        worker, announcer = Worker(store, config, bases), Announcer(store, bus, members, bases)
        while not stop.is_set():
            claims: list[Claim] = []
            try:
                claims = store.claim(config.shard_id, TILES_AT_ONCE, config.lease_s, is_own=members.is_mine)
                leases.hold(claims)
                worker.begin(claims)
                for some in in_turn(claims):
                    if not stop.is_set():
                        _settle(worker, some, metrics)
                    for claim in some:
                        leases.drop(claim)
                    # after the commit; tiles of one batch are announced together
                    metrics.announced(announcer.announce(ANNOUNCE_AT_ONCE, every_s=ANNOUNCE_EVERY_S, is_busy=True))
                n_announced = announcer.announce(ANNOUNCE_AT_ONCE, is_busy=bool(claims))
                metrics.announced(n_announced)
                if not claims and not n_announced:
                    wake.wait(worker.idle_s(store.ready_in_s()))
                    wake.clear()
            except StoreClosed:
                raise
            except StoreError as error:
                metrics.store_failed()
                _LOG.error("%s: the store has failed, next try in %.0f s: %s", config.shard_id, STORE_RETRY_S, error)
                for claim in claims:
                    leases.drop(claim)  # they run out, and whoever can work then has them
                stop.wait(STORE_RETRY_S)
        merged = ", ".join(f"{n} {outcome}" for outcome, n in metrics.merges().items())
        _LOG.info("merger %s: its worker ends; merges of tiles: %s", config.shard_id, merged)


def _settle(worker: Worker, claims: Sequence[Claim], metrics: ShardMetrics) -> None:
    """Load, fold, merge, decide, publish by compare-and-swap."""
    with metrics.merging(len(claims)):
        results = worker.settle_some(claims)
    for result in results:
        metrics.settled(result)
