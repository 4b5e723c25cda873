"""The faults between and of hosts, and how each is begun and ended."""

import os
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, Literal

from gnd.deploy.errors import LabError
from gnd.deploy.lab.hosts.cloud import links_of_region, state_of_witness
from gnd.deploy.lab.hosts.network import LabEnd, lose_between
from gnd.deploy.lab.hosts.plan import BUCKET, DATABASES, HostsPlan, LabHost, client_names
from gnd.deploy.lab.hosts.running import HostsCloud
from gnd.deploy.lab.hosts.slow_disk import disk_of, groups_of_disks, slow_disk
from gnd.deploy.lab.hosts.wrong_clock import compiler
from gnd.deploy.lab.namespaces import pids_in
from gnd.fleet_bus.sealing import MOST_SKEW_S

Way = Literal["process", "host", "silent", "partition", "one-way", "disk", "clock", "boot", "drift", "chaos"]
VEHICLES: Final = "vehicles"
GONE_WITHIN_S: Final = 30.0
_LOOK_S: Final = 0.01

End = Callable[[], None]


@dataclass(frozen=True, slots=True)
class HostFault:
    """A way to hurt the laboratory.

    Attributes:
        name: as the command and the report name it.
        way: a process is killed; all processes of a host; or the host falls silent, as one without power. Or a region
            is cut off from all others, or what it sends is lost and what it is sent arrives. A host's disk is slow,
            its clock is wrong, it is lost and comes back at once with a wrong clock, or the clocks of a region's hosts
            are fast. Or faults of `gnd chaos`, drawn from a seed.
        part: whose process or host it is; "primary", "standby": whoever is it then. Of the last
            region, where it has one; "vehicles": all of that region; "" none.
    """

    name: str
    way: Way
    part: str = ""

    @property
    def is_cut(self) -> bool:
        """Whether a region cannot be served while it lasts."""
        return self.way in ("partition", "one-way")

    @property
    def is_bodiless(self) -> bool:
        """Whether bodies can be neither read nor written while it lasts."""
        return self.part == BUCKET

    @property
    def is_long(self) -> bool:
        """Whether it lasts as long as a region is cut off."""
        return self.is_cut or self.way == "drift"

    @property
    def is_of_clocks(self) -> bool:
        """Whether clocks are wrong while it lasts."""
        return self.way in ("clock", "boot", "drift")

    def is_untimely(self, clock_s: float) -> bool:
        """Whether no new seal of a part with a clock that is so wrong counts, or none that comes to it. Keys that were
        agreed on hold, but only as long as no district changes its owner.
        """
        return self.way in ("clock", "boot") and self.part in ("shard", VEHICLES) and abs(clock_s) >= MOST_SKEW_S


@dataclass(frozen=True, slots=True)
class HowMuch:
    """How much is done where a fault can be small or large.

    Attributes:
        writes_per_s: that a slow disk makes.
        clock_s: by which a wrong clock is wrong, s.
    """

    writes_per_s: int
    clock_s: float


FAULTS: Final = (
    HostFault("router", "process", "router"),
    HostFault("tiles", "process", "tiles"),
    HostFault("shard", "process", "shard"),
    HostFault("database", "process", "primary"),
    HostFault("router-host", "host", "router"),
    HostFault("tiles-host", "host", "tiles"),
    HostFault("shard-host", "host", "shard"),
    HostFault("database-host", "host", "primary"),
    HostFault("standby-host", "host", "standby"),
    HostFault("silent-shard-host", "silent", "shard"),
    HostFault("silent-database-host", "silent", "primary"),
    HostFault("bucket", "process", BUCKET),
    HostFault("bucket-host", "host", BUCKET),
    HostFault("silent-bucket-host", "silent", BUCKET),
    HostFault("partition", "partition"),
    HostFault("one-way", "one-way"),
    HostFault("slow-disk", "disk", "primary"),
    HostFault("slow-standby-disk", "disk", "standby"),
    HostFault("clock-router-host", "clock", "router"),
    HostFault("clock-tiles-host", "clock", "tiles"),
    HostFault("clock-shard-host", "clock", "shard"),
    HostFault("clock-database-host", "clock", "primary"),
    HostFault("clock-vehicles", "clock", VEHICLES),
    HostFault("boot-shard-host", "boot", "shard"),
    HostFault("boot-vehicles", "boot", VEHICLES),
    HostFault("drift", "drift"),
    HostFault("chaos", "chaos"),
)
BY_FAULT: Final = {fault.name: fault for fault in FAULTS}
DEFAULT_FAULTS: Final = "router-host,tiles-host,shard-host,database-host,partition"


def parse_faults(text: str) -> tuple[HostFault, ...]:
    """Read names with commas; "all" are all.

    Raises:
        LabError: no name, or one that is not known.
    """
    names = [word.strip() for word in text.split(",") if word.strip()]
    if names == ["all"]:
        return FAULTS
    unknown = [name for name in names if name not in BY_FAULT]
    if unknown or not names:
        raise LabError(f"no fault {', '.join(unknown) or repr(text)}; there are: all, {', '.join(BY_FAULT)}")
    return tuple(BY_FAULT[name] for name in names)


def chosen_faults(text: str | None, plan: HostsPlan) -> tuple[HostFault, ...]:
    """The faults of a run: those that are named, else the usual ones that this laboratory can survive.

    Raises:
        LabError: one is not known, or this laboratory cannot survive it by its plan.
    """
    if text is None:
        return tuple(fault for fault in parse_faults(DEFAULT_FAULTS) if not why_not_survived(fault, plan))
    faults = parse_faults(text)
    if faults == FAULTS:  # all that there can be here
        faults = tuple(fault for fault in faults if not _lacks(fault, plan))
    for fault in faults:
        if why := why_not_survived(fault, plan):
            raise LabError(f"fault {fault.name}: {why}")
    return faults


def why_not_survived(fault: HostFault, plan: HostsPlan) -> str:
    """What this laboratory lacks; empty: nothing."""
    if lacks := _lacks(fault, plan):
        return lacks
    is_database = fault.part in ("primary", "standby")
    if fault.way in ("disk", "clock", "drift", "chaos") or fault.part == VEHICLES:
        return ""
    if is_database and not plan.has_witness:
        return "the loss of a database host needs a third host, which decides who goes on"
    if not is_database and fault.part != BUCKET and plan.size.regions < 2:
        return "needs 2 regions, so that the other one goes on"
    if (
        fault.way in ("host", "silent", "boot")
        and not plan.has_witness
        and set(DATABASES) & _parts_of_host(fault, plan)
    ):
        return "its host has a database, and there is no third host, which decides who goes on"
    return ""


def _lacks(fault: HostFault, plan: HostsPlan) -> str:
    """What this laboratory or this machine lacks; empty: nothing."""
    if fault.part == BUCKET and not plan.size.has_bucket:
        return "there is no bucket (--bucket)"
    try:
        if fault.is_of_clocks:
            compiler()
        elif fault.way == "disk":
            groups_of_disks()
    except LabError as error:
        return str(error)
    return ""


def _parts_of_host(fault: HostFault, plan: HostsPlan) -> set[str]:
    name = fault.part if fault.part == BUCKET else f"{fault.part}-{plan.size.regions - 1}"
    return set(plan.host_of(name).parts)


def begin_fault(cloud: HostsCloud, fault: HostFault, how_much: HowMuch) -> tuple[str, End]:
    """Do it.

    Returns:
        What was hit, in words, and how to end it.
    """
    if fault.way == "drift":
        return _drift(cloud)
    if fault.is_cut:
        return _cut(cloud, both=fault.way == "partition")
    if fault.part == VEHICLES:
        return _hurt_vehicles(cloud, how_much.clock_s, boot=fault.way == "boot")
    part = _part(cloud, fault.part)
    host = cloud.plan.host_of(part)
    if fault.way == "process":
        cloud.lose((part,))
        return f"{part} on {host.name}", lambda: cloud.give_back((part,))
    if fault.way == "disk":
        return _slow(cloud, host, how_much.writes_per_s)
    if fault.way == "clock":
        end_clock = cloud.host_clocks.step(host.name, offset_s=how_much.clock_s)
        return f"{how_much.clock_s:+g} s at {host.name}: {', '.join(host.parts)}", end_clock
    if fault.way == "boot":
        end_clock = cloud.host_clocks.step(host.name, offset_s=how_much.clock_s)
        cloud.lose(host.parts, lambda: kill_all(host))
        cloud.give_back(host.parts)
        return f"{how_much.clock_s:+g} s at {host.name}: {', '.join(host.parts)}", end_clock
    undo = _silence(cloud, host) if fault.way == "silent" else _nothing
    cloud.lose(host.parts, lambda: kill_all(host))  # at once: who outlives its router would go to another one

    def end() -> None:
        undo()
        cloud.give_back(host.parts)

    return f"{host.name}: {', '.join(host.parts)}", end


def _part(cloud: HostsCloud, part: str) -> str:
    if part == BUCKET:
        return part
    if part not in ("primary", "standby"):
        return f"{part}-{cloud.plan.size.regions - 1}"
    state = state_of_witness(cloud.folders) or {"primary": DATABASES[0]}
    primary = str(state["primary"])
    return primary if part == "primary" else DATABASES[1 - DATABASES.index(primary)]


def _cut(cloud: HostsCloud, *, both: bool) -> tuple[str, End]:
    """The last region, hosts and vehicles, from all others."""
    *rest, region = range(cloud.plan.size.regions)
    inside, own = _ends(cloud, region), cloud.plan.in_region(region)
    others = [end for other in rest for end in _ends(cloud, other)]
    undo = _lose(cloud, inside, others, both=both)
    return f"region {region}: {', '.join(host.name for host in own)}", undo


def _drift(cloud: HostsCloud) -> tuple[str, End]:
    """The clocks of the last region's hosts."""
    own = cloud.plan.in_region(cloud.plan.size.regions - 1)
    return f"1 s a minute at {', '.join(host.name for host in own)}", cloud.host_clocks.drift(
        *(host.name for host in own)
    )


def _hurt_vehicles(cloud: HostsCloud, clock_s: float, *, boot: bool) -> tuple[str, End]:
    """The clocks of the last region's vehicles, which are started anew if so asked."""
    *vehicles, _ = client_names(cloud.plan, cloud.plan.size.regions - 1)
    end = cloud.host_clocks.step(*vehicles, offset_s=clock_s)
    if boot:
        cloud.lose(vehicles)
        cloud.give_back(vehicles)
    return f"{clock_s:+g} s at {', '.join(vehicles)}", end


def _slow(cloud: HostsCloud, host: LabHost, writes_per_s: int) -> tuple[str, End]:
    """The disk of all that runs on a host."""
    end = slow_disk(cloud.lab.name, disk_of(cloud.folders.data), pids_in(host.namespace), writes_per_s)
    return f"{writes_per_s} writes a second at {host.name}: {', '.join(host.parts)}", end


def _nothing() -> None:
    pass


def _lose(cloud: HostsCloud, sources: Sequence[LabEnd], targets: Sequence[LabEnd], *, both: bool) -> End:
    middle = cloud.lab.cloud_namespace
    undo = lose_between(middle, sources, targets)
    undo_other = lose_between(middle, targets, sources) if both else _nothing

    def end() -> None:
        undo()
        undo_other()

    return end


def _ends(cloud: HostsCloud, region: int) -> list[LabEnd]:
    links = links_of_region(cloud.plan, cloud.lab, region)
    return [*map(LabEnd.of_host, cloud.plan.in_region(region)), *map(LabEnd.of_link, links)]


def _silence(cloud: HostsCloud, host: LabHost) -> End:
    """Nothing comes from a host any more, and nothing that is sent there is answered."""
    own = LabEnd.of_host(host)
    everybody = [LabEnd.of_host(one) for one in cloud.plan.hosts if one != host]
    everybody += [LabEnd.of_link(link) for link in cloud.lab.links]
    return _lose(cloud, [own], everybody, both=True)


def kill_all(host: LabHost) -> None:
    """End every process of a host by SIGKILL, those too that are started meanwhile.

    Raises:
        LabError: some do not go.
    """
    deadline_s = time.monotonic() + GONE_WITHIN_S
    while pids := pids_in(host.namespace):
        if time.monotonic() > deadline_s:
            raise LabError(f"{len(pids)} processes of {host.name} do not end")
        for pid in pids:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(_LOOK_S)


def is_back(cloud: HostsCloud) -> bool:
    """Whether the database has two sides again, so that the next fault finds what it needs."""
    state = state_of_witness(cloud.folders)
    return not cloud.plan.has_witness or (state is not None and not state["is_alone"])
