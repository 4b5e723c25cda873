"""Real namespaces and links: what they pass, what they refuse, and the ledger against the interfaces' counters."""

import contextlib
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from lab_testing import (
    asking_role,
    echo_role,
    has_namespaces,
    needs_root,
    own_name,
    profile_file,
    router_role,
    wait_until,
)

from gnd.deploy.errors import LabError, LabRuns
from gnd.deploy.lab.check import carried
from gnd.deploy.lab.counters import read_counts
from gnd.deploy.lab.groups import ROUTER_FROM_CLOUD, ROUTER_LISTENS, Group, parse_groups
from gnd.deploy.lab.lab import LOCK_FOLDER, Lab, lab_lock, labs, namespaces_of, open_lab
from gnd.deploy.lab.namespaces import add_namespace, enter_namespace, inside, remove_namespace, run_tool
from gnd.deploy.lab.probes import bulk, flood, stream
from gnd.deploy.lab.relay import read_account
from gnd.deploy.lab.report import Evidence, GroupAccount, account, as_json, count_links
from gnd.deploy.lab.run import relay_processes
from gnd.deploy.lab.sampler import sampling
from gnd.deploy.lab.tables import run_table, run_verdict
from gnd.deploy.processes import ProcessSpec, Supervisor
from gnd.fleet_bus.ledger_file import read_ledger

pytestmark = [needs_root, pytest.mark.xdist_group("hosts")]

OWN_NAMESPACE = Path("/proc/thread-self/ns/net")
PROFILES = """
[far]
down_bit_s = 8e6
up_bit_s = 4e6
delay_ms = 20
jitter_ms = 4
loss = 0.05

[near]
down_bit_s = 8e6
up_bit_s = 4e6
"""


@pytest.fixture
def groups(tmp_path: Path) -> tuple[Group, ...]:
    file = profile_file(tmp_path, PROFILES)
    return parse_groups(f"{file}:far:1,{file}:near:1")


@pytest.fixture
def lab(groups: tuple[Group, ...]) -> Iterator[Lab]:
    with open_lab(own_name(), groups, relay_all=True) as opened:
        yield opened


@pytest.mark.slow
def test_links_pass_what_their_profiles_say(lab: Lab) -> None:
    far, near = lab.links
    assert lab.relayed == (far,)
    with carried(lab):
        for direction, rate_bit_s in (("up", 4e6), ("down", 8e6)):
            thin = stream(far, direction, 0.5)
            assert 0 < thin.lost < 0.05 * thin.sent + 6 * (0.05 * thin.sent) ** 0.5
            assert thin.reordered == 0
            assert thin.delay_ms[0] >= 16
            assert stream(near, direction, 0.2).lost == 0
            # A bucket of 16 kB may pass at once beside the rate; a busy machine may be slower, never faster.
            assert 0 < flood(far, direction, 0.5) < rate_bit_s * 1.03 + 8 * 16_384 / 0.4
            assert 0 < bulk(near, direction, 0.5).bit_s < rate_bit_s + 8 * 16_384 / 0.5


def test_a_link_reaches_nothing_but_its_other_end(lab: Lab) -> None:
    far, near = lab.links
    with carried(lab):
        routes = run_tool("ip", "-n", far.vehicle_namespace, "route")
        assert routes.split()[:3] == [far.cloud_address, "dev", far.vehicle_device]
        assert len(routes.splitlines()) == 1
        assert near.cloud_address not in routes


def test_a_lab_ends_without_a_trace(groups: tuple[Group, ...]) -> None:
    name = own_name()

    def fail() -> None:
        with open_lab(name, groups):
            assert len(namespaces_of(name)) == 3
            assert name in labs()
            raise KeyError(name)

    with pytest.raises(KeyError):
        fail()
    assert namespaces_of(name) == ()
    assert name not in labs()


def test_a_lab_that_the_kernel_refuses_half_way_is_removed(groups: tuple[Group, ...]) -> None:
    name = own_name()
    add_namespace(f"gndlab-{name}")  # no namespace of a lab: its name has other signs
    try:
        broken = parse_groups("3g:1")[0]
        twice = (broken, Group("3g", broken.link, 0, 1))  # the second makes the first's devices again
        with pytest.raises(LabError, match=r"`ip .* failed with code \d+: .*"), open_lab(name, twice):
            pass
        assert namespaces_of(name) == ()
    finally:
        remove_namespace(f"gndlab-{name}")


def test_a_name_that_runs_is_refused(lab: Lab, groups: tuple[Group, ...]) -> None:
    with pytest.raises(LabRuns, match=rf"'{lab.name}' runs \(process {os.getpid()}\).*--name"), open_lab(
        lab.name, groups
    ):  # fmt: skip
        pass
    assert len(namespaces_of(lab.name)) == 3  # untouched


def test_leftovers_are_refused(groups: tuple[Group, ...]) -> None:
    name = own_name()
    add_namespace(f"gndlab.{name}.cloud")
    try:
        with pytest.raises(LabError, match="left 1 namespaces: remove them with `gnd lab clean`"), open_lab(
            name, groups
        ):  # fmt: skip
            pass
        assert has_namespaces(name)  # not removed by the lab that was refused
    finally:
        remove_namespace(f"gndlab.{name}.cloud")


def test_a_lock_ends_with_its_block() -> None:
    name = own_name()
    for _ in range(2):
        with lab_lock(name):
            assert (LOCK_FOLDER / f"{name}.lock").read_text() == f"{os.getpid()}\n"
        assert not (LOCK_FOLDER / f"{name}.lock").exists()


def test_namespaces_that_are_not_there_are_named() -> None:
    with pytest.raises(LabError, match=r"cannot open the network namespace .*absent: No such file"):
        enter_namespace("gndlab.absent")
    before = OWN_NAMESPACE.stat().st_ino
    with contextlib.suppress(LabError), inside("gndlab.absent"):
        pass
    assert OWN_NAMESPACE.stat().st_ino == before


@contextlib.contextmanager
def supervised(folder: Path) -> Iterator[Supervisor]:
    supervisor = Supervisor(folder, folder / "pids.json")
    try:
        yield supervisor
    finally:
        supervisor.stop()


def run_bus(lab: Lab, folder: Path, *, rounds: int, size: int, kill_relay: bool = False) -> GroupAccount:
    """A router and an echo in the cloud, one vehicle that asks over the first link; the account of that link."""
    relays, link = folder / "relays", lab.links[0]
    with sampling(lab) as seen, supervised(folder) as supervisor:
        for spec in (
            *relay_processes(lab, relays),
            ProcessSpec("router", router_role, (ROUTER_LISTENS,), namespace=lab.cloud_namespace),
            ProcessSpec("echo", echo_role, (ROUTER_FROM_CLOUD,), namespace=lab.cloud_namespace),
        ):
            supervisor.start(spec)
        asking = (link.endpoint, folder / "vehicle-00.jsonl", rounds, size)
        supervisor.start(ProcessSpec("asking", asking_role, asking, namespace=link.vehicle_namespace))
        if kill_relay:
            wait_until(lambda: read_counts(link).up_bytes > size, "the vehicle has sent")
            relay = supervisor.pids()["link-far"]
            os.kill(relay, signal.SIGKILL)
        wait_until(lambda: supervisor.poll() is None and supervisor.finished("asking"), "all is answered")
        assert not kill_relay or supervisor.restarts["link-far"] == 1
    ledgers = {0: read_ledger(folder / "vehicle-00.jsonl")}
    evidence = Evidence(count_links(lab), seen, read_account(relays), ledgers)
    (group,) = account(lab, evidence)
    return group


@pytest.mark.parametrize("profile", ["far", "near"])
def test_ledger_and_interface_agree(tmp_path: Path, profile: str) -> None:
    groups = parse_groups(f"{profile_file(tmp_path, PROFILES)}:{profile}:1")
    with open_lab(own_name(), groups, relay_all=True) as lab:
        group = run_bus(lab, tmp_path, rounds=6, size=20_000)
    assert group.carried_by == ("relay" if profile == "far" else "kernel")
    for direction, payload in ((group.up, 6 * 20_000), (group.down, 6 * 40_000)):
        assert direction.interface_bytes > payload
        assert direction.agrees, direction
        assert direction.packets > payload / 1400
    assert (group.down.lost > 0) == (profile == "far")
    assert group.shortest_ms is None or group.shortest_ms >= 2 * (group.wanted_delay_ms - group.wanted_jitter_ms)
    report = as_json("x", (group,))
    assert run_verdict(report) == "ledger and interface counters agree within 5 % in every namespace"
    assert run_table(report).row_count == 2


def test_a_vehicle_that_books_too_little_does_not_agree(tmp_path: Path) -> None:
    groups = parse_groups(f"{profile_file(tmp_path, PROFILES)}:near:1")
    with open_lab(own_name(), groups) as lab:
        with carried(lab):
            stream(lab.links[0], "up", 0.2)  # traffic that no ledger knows
        with sampling(lab) as seen:
            pass
        (group,) = account(lab, Evidence(count_links(lab), seen, {}, {}))
    assert group.up.difference == -1.0
    assert not group.up.agrees
    assert run_verdict(as_json("x", (group,))).endswith("differ by more than 5 %: near down, near up")


@pytest.mark.slow
def test_a_killed_relay_is_an_outage_that_the_bus_survives(tmp_path: Path) -> None:
    groups = parse_groups(f"{profile_file(tmp_path, PROFILES)}:far:1")
    with open_lab(own_name(), groups, relay_all=True) as lab:
        group = run_bus(lab, tmp_path, rounds=6, size=20_000, kill_relay=True)
    assert group.up.agrees, group.up
    assert group.down.interface_bytes > 6 * 40_000
