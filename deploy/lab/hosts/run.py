"""One run over hosts: start, be calm, hurt and wait for each fault, let it settle, look."""

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final

from gnd.deploy.chaos.checks import Findings, compare_reports, find_stuck, find_unsigned, read_outbox, verified
from gnd.deploy.chaos.clients import ENOUGH, OPEN_SUFFIX
from gnd.deploy.chaos.inflict import retry
from gnd.deploy.chaos.run import HURRIED_S, RETRY_S
from gnd.deploy.chaos.street import LAYER, ChaosStreet, read_street
from gnd.deploy.errors import LabError
from gnd.deploy.fleet_identities import FLEET, sign_map
from gnd.deploy.interruption import EndEvent
from gnd.deploy.lab.hosts.chaos import LabChaos, lab_chaos
from gnd.deploy.lab.hosts.cloud import (
    HEARD_SUFFIX,
    LabFolders,
    client_processes,
    identity_of,
    read_times,
    with_identities,
)
from gnd.deploy.lab.hosts.faults import HostFault, HowMuch, begin_fault, is_back
from gnd.deploy.lab.hosts.identities import make_lab_identities
from gnd.deploy.lab.hosts.plan import HostsPlan, client_names
from gnd.deploy.lab.hosts.running import HostsCloud, running_hosts
from gnd.deploy.lab.hosts.verdict import LONGEST_GAP_S, HostsOutcome, HostTrial
from gnd.deploy.lab.lab import Lab
from gnd.deploy.lab.namespaces import inside
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.errors import StoreError
from gnd.tile_store.location import open_store
from gnd.tile_store.sqlite_store import SqlStore

READY_S: Final = 300.0
BACK_S: Final = 90.0
"""After a fault all regions must be served again within so long."""
CALM_S: Final = 5.0
SETTLE_S: Final = 900.0
SERVED_LATELY_S: Final = 1.5
MOST_WRITES: Final = 10_000
MOST_CLOCK_S: Final = 1e8
_LOOK_S: Final = 0.2

OnHostsStep = Callable[[str, int], None]
"""Called with what is done now, and how many faults there have been."""


@dataclass(frozen=True, slots=True)
class HostsOptions:
    """What is done in a run.

    Attributes:
        faults: in order.
        seed: of the reports.
        every_s: how often a vehicle has a report, on average, s.
        away_s: how long what is lost stays away, s.
        partition_s: how long a region is cut off, s.
        longest_gap_s: allowed without service, s.
        writes_per_s: that a slow disk makes.
        clock_s: by which a wrong clock is wrong, s.
        chaos: so many faults of chaos in one.
    """

    faults: tuple[HostFault, ...]
    seed: int = 1
    every_s: float = 0.5
    away_s: float = 10.0
    partition_s: float = 60.0
    longest_gap_s: float = LONGEST_GAP_S
    writes_per_s: int = 5
    clock_s: float = 600.0
    chaos: int = 30

    def __post_init__(self) -> None:
        for name in ("every_s", "away_s", "partition_s", "longest_gap_s"):
            if not 0.05 <= getattr(self, name) <= 3600:
                raise LabError(f"{name} must be 0.05 to 3600, got {getattr(self, name)}")
        if not 1 <= self.writes_per_s <= MOST_WRITES:
            raise LabError(f"writes_per_s must be 1 to {MOST_WRITES}, got {self.writes_per_s}")
        if not 1.0 <= abs(self.clock_s) <= MOST_CLOCK_S:
            raise LabError(f"clock_s must be 1 to {MOST_CLOCK_S:g}, or that below 0, got {self.clock_s}")

    @property
    def how_much(self) -> HowMuch:
        """How much is done."""
        return HowMuch(self.writes_per_s, self.clock_s)


def run_hosts(
    plan: HostsPlan,
    lab: Lab,
    folders: LabFolders,
    options: HostsOptions,
    stop: EndEvent,
    on_step: OnHostsStep = lambda _what, _n: None,
) -> HostsOutcome:
    """Run the laboratory, inflict the faults, let it settle and look at what is left.

    The fork server must have been started; namespaces and links must be there, and the network between them.

    Args:
        plan: which part is on which host.
        lab: namespaces and links.
        folders: made.
        options: of the run.
        stop: ends the faults early; what was found until then is the outcome. It is awaited from when the laboratory
            works.
        on_step: progress.

    Raises:
        LabError: the laboratory did not begin to work.
    """
    on_step("starting", 0)
    if plan.size.is_secure:
        make_lab_identities(plan, folders.root)
    street = read_street(districts=max(2, plan.size.regions))
    with (
        inside(lab.cloud_namespace),
        running_hosts(
            plan,
            lab,
            folders,
            lambda store: _put_street(street, store),
            has_clocks=any(fault.is_of_clocks for fault in options.faults),
        ) as cloud,
    ):
        vehicles = client_processes(plan, lab, folders, options.seed, options.every_s)
        cloud.start(with_identities(plan, folders, vehicles))
        with ExitStack() as stack:
            store = stack.enter_context(open_store(plan.database_url, create=False))
            chaos = None
            if any(fault.way == "chaos" for fault in options.faults):
                chaos = stack.enter_context(lab_chaos(cloud, street, options.seed, store))
            course = _Course(cloud, options, stop, on_step, chaos)
            course.wait_for_work()
            stop.is_awaited = True
            calm = course.calm()
            trials = course.trials()
            on_step("settling", len(trials))
            settled_s = _settle(cloud, store, HURRIED_S if stop.is_set() else SETTLE_S, chaos)
            on_step("checking", len(trials))
            findings = _look(cloud, store)
        restarts, died = dict(cloud.supervisor.restarts), tuple(cloud.died)
        on_step("ending", len(trials))
    return HostsOutcome(
        plan={host.name: list(host.parts) for host in plan.hosts},
        size=asdict(plan.size),
        seed=options.seed,
        calm=calm,
        trials=tuple(trials),
        findings=findings,
        settled_s=settled_s,
        longest_gap_s=options.longest_gap_s,
        interrupted=stop.is_set(),
        restarts=restarts,
        died=died,
        chaos=tuple(chaos.rows) if chaos else (),
    )


def _put_street(street: ChaosStreet, store: SqlStore) -> TileId:
    store.put_tiles(street.tiles)
    if store.signing is not None:
        sign_map(store)
    return street.tiles[0].tile_id


class _Course:
    """What happens while the clients work."""

    def __init__(
        self,
        cloud: HostsCloud,
        options: HostsOptions,
        stop: EndEvent,
        on_step: OnHostsStep,
        chaos: LabChaos | None,
    ) -> None:
        self._cloud, self._options, self._stop, self._on_step = cloud, options, stop, on_step
        self._chaos = chaos

    def wait_for_work(self) -> None:
        """Until all regions are served and something is merged: before that nothing can be lost.

        Raises:
            LabError: that does not happen.
        """
        deadline_s = time.monotonic() + READY_S
        with open_store(self._cloud.plan.database_url, create=False) as store:
            while not (self._is_served() and any(head.version > 1 for head in store.heads())):
                if time.monotonic() > deadline_s or self._cloud.died:
                    logs = self._cloud.folders.logs
                    raise LabError(f"nothing was merged within {READY_S:g} s: read {logs}; {self._cloud.died}")
                if self._stop.wait(_LOOK_S):
                    return
        self._stop.wait(CALM_S)  # shards come to know each other

    def calm(self) -> HostTrial:
        """Some seconds without a fault: what pauses there are anyway."""
        self._on_step("calm", 0)
        began_s = time.monotonic()
        self._stop.wait(2 * CALM_S)
        return self._trial("none", "", (began_s, began_s), is_cut=False)

    def trials(self) -> list[HostTrial]:
        """One fault after the other, or until `stop` is set."""
        done: list[HostTrial] = []
        for fault in self._options.faults:
            if self._stop.is_set() or self._cloud.died:
                break
            self._on_step(fault.name, len(done))
            done.append(self._inflict(fault))
        return done

    def _inflict(self, fault: HostFault) -> HostTrial:
        began_s = time.monotonic()
        if fault.way == "chaos" and self._chaos is not None:
            where = self._chaos.inflict(self._options.chaos, self._stop)
            return self._ended(fault, where, (began_s, time.monotonic()))
        where, end = begin_fault(self._cloud, fault, self._options.how_much)
        try:
            self._stop.wait(self._options.partition_s if fault.is_long else self._options.away_s)
        finally:
            ended_s = time.monotonic()
            end()
        return self._ended(fault, where, (began_s, ended_s))

    def _ended(self, fault: HostFault, where: str, span_s: tuple[float, float]) -> HostTrial:
        self._wait_until_back()
        self._stop.wait(CALM_S)
        trial = self._trial(fault.name, where, span_s, is_cut=fault.is_cut)
        is_untimely = self._cloud.plan.size.is_secure and fault.is_untimely(self._options.clock_s)
        return replace(trial, is_bodiless=fault.is_bodiless, is_untimely=is_untimely)

    def _wait_until_back(self) -> None:
        deadline_s = time.monotonic() + BACK_S
        while not (self._is_served() and is_back(self._cloud)):
            if time.monotonic() > deadline_s or self._stop.wait(_LOOK_S):
                return

    def _is_served(self) -> bool:
        """Whether every client has been served lately."""
        lately_s = time.monotonic() - SERVED_LATELY_S
        files = [self._file(name) for region in self._regions for name in client_names(self._cloud.plan, region)]
        return all((times_s := read_times([file])) and times_s[-1] > lately_s for file in files)

    def _trial(self, fault: str, where: str, span_s: tuple[float, float], *, is_cut: bool) -> HostTrial:
        until_s = time.monotonic()
        names = [client_names(self._cloud.plan, region) for region in self._regions]
        acks_s = [read_times(map(self._file, own[:-1])) for own in names]
        tiles_s = [read_times(map(self._file, own[-1:])) for own in names]
        versions_s = [read_times([self._file(own[-1]).with_suffix(HEARD_SUFFIX)]) for own in names]
        return HostTrial(fault, where, *span_s, until_s, is_cut, len(names) - 1, acks_s, tiles_s, versions_s)

    @property
    def _regions(self) -> range:
        return range(self._cloud.plan.size.regions)

    def _file(self, client: str) -> Path:
        return self._cloud.folders.times / f"{client}.times"


def _vehicles(plan: HostsPlan) -> Sequence[str]:
    return [name for region in range(plan.size.regions) for name in client_names(plan, region)[:-1]]


def _settle(cloud: HostsCloud, store: SqlStore, within_s: float, chaos: LabChaos | None) -> float | None:
    """Let the vehicles finish and the cloud work off what it has; how long it took, None: it came to no end. What
    chaos has brought to be set aside is merged again.
    """
    begin_s = retried_s = time.monotonic()
    (cloud.folders.vehicles / ENOUGH).touch()
    while time.monotonic() < begin_s + within_s and not cloud.died:
        time.sleep(_LOOK_S)
        with suppress(StoreError):
            if not _still_open(cloud) + (chaos.still_open() if chaos else 0) and _has_no_work(store):
                return time.monotonic() - begin_s
            if chaos and time.monotonic() - retried_s > RETRY_S:
                retried_s = time.monotonic()
                retry(store)
    return None


def _still_open(cloud: HostsCloud) -> int:
    told = [cloud.folders.vehicles / f"{name}{OPEN_SUFFIX}" for name in _vehicles(cloud.plan)]
    if not all(path.exists() for path in told):
        return 1
    return sum(int(path.read_text(encoding="utf-8")) for path in told)


def _has_no_work(store: SqlStore) -> bool:
    is_read = not {"waiting", "early"} & set(store.upload_counts().by_state)
    return is_read and not store.dirty_count() and not store.tiles_set_aside() and not store.notices()


def _look(cloud: HostsCloud, store: SqlStore) -> Findings:
    """Compare what the vehicles hold with what is in the database, after all that writes has ended."""
    plan = cloud.plan
    names = [name for region in range(plan.size.regions) for name in client_names(plan, region)]
    cloud.stop([*names, *(f"shard-{region}" for region in range(plan.size.regions))])
    found = Findings()
    kept = [one for path in sorted(cloud.folders.vehicles.glob("*.sqlite")) for one in read_outbox(path)]
    compare_reports(found, store, kept)
    found.received = len(read_times(cloud.folders.times.glob("asker-*.times")))
    histories = (store.history(LAYER, head.tile) for head in store.heads(LAYER))
    found.versions = sum(info.kind == "merged" for history in histories for info in history)
    find_stuck(found, store)
    if (own := identity_of(plan, cloud.folders, FLEET)) is not None:
        find_unsigned(found, store, own)
    found.verify, found.identical_map = verified(plan.database_url)
    return found
