"""The laboratory of hosts as a plan: where parts run, what is refused, who may take writes, how gaps are counted."""

import io
import json
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import pytest
from lab_testing import finished, gnd_lab
from rich.console import Console
from suite_ports import new_port

from gnd.deploy.chaos.checks import Findings
from gnd.deploy.errors import LabError
from gnd.deploy.lab.groups import DEFAULT_GROUPS
from gnd.deploy.lab.hosts import data
from gnd.deploy.lab.hosts.cloud import read_times
from gnd.deploy.lab.hosts.faults import BY_FAULT, FAULTS, chosen_faults, parse_faults
from gnd.deploy.lab.hosts.identities import members_of
from gnd.deploy.lab.hosts.plan import DATABASES, OF_REGION, WITNESS, HostsSize, client_names, plan_hosts
from gnd.deploy.lab.hosts.run import HostsOptions
from gnd.deploy.lab.hosts.slow_disk import disk_of, groups_of_disks
from gnd.deploy.lab.hosts.tables import print_hosts
from gnd.deploy.lab.hosts.verdict import HostsOutcome, HostTrial, longest_gap_s
from gnd.deploy.lab.hosts.witness import WitnessClient, WitnessState, witness
from gnd.deploy.lab.hosts.wrong_clock import HostClocks, clocks_may_be_wrong


@pytest.mark.parametrize("size", [(r, h) for h in range(2, 9) for r in range(1, h + 1)])
def test_every_part_has_one_host_and_sides_that_stand_in_for_each_other_have_two(size: tuple[int, int]) -> None:
    regions, hosts = size
    plan = plan_hosts("t", HostsSize(regions, hosts))
    parts = [part for host in plan.hosts for part in host.parts]
    of_regions = {f"{part}-{region}" for part in OF_REGION for region in range(regions)}
    assert sorted(parts) == sorted({*DATABASES, "hub", *of_regions, *(["witness"] if hosts > 2 else [])})
    assert plan.host_of(DATABASES[0]) != plan.host_of(DATABASES[1])
    assert {host.region for host in plan.hosts} == set(range(regions))
    assert all(plan.host_of(f"{part}-{r}").region == r for part in OF_REGION for r in range(regions))
    if hosts > 2:
        assert not set(DATABASES) & set(plan.host_of("witness").parts)
    assert len({host.address for host in plan.hosts}) == hosts


def test_with_room_nothing_shares_a_host_with_the_database() -> None:
    plan = plan_hosts("t", HostsSize(regions=2, hosts=12))
    assert [plan.host_of(part).parts for part in DATABASES] == [("database-a",), ("database-b",)]
    assert plan.host_of("hub").parts == ("router-1", "hub")
    assert max(len(host.parts) for host in plan.hosts) == 2


def test_a_store_is_looked_for_at_both_hosts_and_written_where_it_can_be() -> None:
    url = plan_hosts("t", HostsSize(2, 4)).database_url
    assert url.startswith("postgresql://gnd@198.19.0.2:5432,198.19.1.2:5432/gnd?target_session_attrs=read-write")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("hosts", "--hosts", "1"), "1 hosts: a database and its standby need 2"),
        (("hosts", "--hosts", "33"), "32 is the most"),
        (("--regions", "3", "--hosts", "2"), "3 regions on 2 hosts"),
        (("--regions", "0", "--hosts", "2"), "0 regions on 2 hosts"),
        (("--hosts", "1"), "1 hosts: a database and its standby need 2"),
        (("--regions", "2", "--hosts", "4", "--groups", DEFAULT_GROUPS), "--groups does not go with --regions"),
        (("hosts", "--vehicles", "0"), "0 vehicles a region"),
        (("hosts", "--faults", "earthquake,router"), "no fault earthquake; there are: all, router, tiles"),
        (("hosts", "--faults", ","), "no fault ','"),
        (("hosts", "--hosts", "2", "--faults", "database-host"), "needs a third host, which decides"),
        (("hosts", "--regions", "1", "--faults", "partition"), "needs 2 regions"),
        (("hosts", "--cut", "nan"), "partition_s must be 0.05 to 3600, got nan"),
        (("hosts", "--writes", "0"), "writes_per_s must be 1 to 10000, got 0"),
        (("hosts", "--clock", "nan"), "clock_s must be 1 to 1e+08"),
        (("hosts", "--faults", "silent-bucket-host"), "there is no bucket (--bucket)"),
        (("hosts", "--link", "6g"), "no link profile '6g'"),
        (("hosts", "--name", "../x"), "a lab's name is 1 to 20 of a-z"),
    ],
)
def test_what_cannot_work_is_refused_before_anything_is_made(arguments: tuple[str, ...], words: str) -> None:
    code, out, err = finished(gnd_lab(*arguments))
    assert (code, out) == (2, "")
    assert err.startswith("gnd: ")
    assert words in err


def test_the_folder_of_a_run_must_be_empty(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    code, _, err = finished(gnd_lab("hosts", "--out", str(tmp_path)))
    assert code == 2
    assert "root" in err or "exists and is not empty" in err


def test_faults_are_read_by_name() -> None:
    assert parse_faults("all") == FAULTS
    assert [fault.name for fault in parse_faults(" partition, router,")] == ["partition", "router"]


def test_all_faults_are_those_that_a_laboratory_and_its_machine_can_have(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    without = {fault.name for fault in chosen_faults("all", plan_hosts("t", HostsSize(2, 4)))}
    of_buckets = {"bucket", "bucket-host", "silent-bucket-host"}
    of_clocks = {fault.name for fault in FAULTS if fault.is_of_clocks}
    assert without & (of_buckets | of_clocks) == set()
    having = chosen_faults("all", plan_hosts("t", HostsSize(2, 4, has_bucket=True)))
    assert {fault.name for fault in having} - without == of_buckets
    for name, words in (("bucket", "there is no bucket"), ("drift", "wrong clocks need a C compiler")):
        with pytest.raises(LabError, match=words):
            chosen_faults(name, plan_hosts("t", HostsSize(2, 4)))


def test_the_bucket_stands_away_from_the_database() -> None:
    for hosts in range(3, 9):
        plan = plan_hosts("t", HostsSize(2, hosts, has_bucket=True))
        assert not set(DATABASES) & set(plan.host_of("bucket").parts)


def test_of_repeated_faults_the_mean_and_the_worst_are_told() -> None:
    quick, slow = [10.2, 11.0, 12.0, 13.0, 14.2], [10.2, 13.2, 14.2]
    good = Findings(reports=3, acknowledged=3, versions=1, received=9, identical_map=True)
    found = outcome((trial([quick]), trial([slow])), good)
    (told,) = found.as_dict()["by_fault"]
    assert told["ack_gap_s"] == {"mean": 2.1, "worst": 3.0}
    assert (told["fault"], told["times"], told["back_s"]) == ("x", 2, None)
    console = Console(width=150, record=True, file=io.StringIO())
    print_hosts(console, found)
    assert "2.10, 3.00" in console.export_text()
    (told,) = outcome((trial([quick, quick], is_cut=True),), good).as_dict()["by_fault"]
    assert told["back_s"] == {"mean": 0.5, "worst": 0.5}


def groups_folder(root: Path, version: int) -> Path:
    if version == 1:
        (root / "blkio").mkdir(parents=True)
        (root / "blkio" / "blkio.throttle.write_iops_device").touch()
    else:
        root.mkdir()
        (root / "cgroup.controllers").write_text("cpu io memory\n")
    return root


def test_either_version_of_control_groups_can_slow_a_disk(tmp_path: Path) -> None:
    one = groups_of_disks(groups_folder(tmp_path / "one", 1))
    assert (one.bound, one.group_of("t")) == (
        "blkio.throttle.write_iops_device",
        tmp_path / "one" / "blkio" / "gndlab-t",
    )
    two = groups_of_disks(groups_folder(tmp_path / "two", 2))
    assert (two.bound, two.before, two.root) == ("io.max", "wiops=", tmp_path / "two")
    with pytest.raises(LabError, match="no control groups of disks under"):
        groups_of_disks(tmp_path)


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_a_clock_is_wrong_in_the_processes_of_its_host_alone_and_nothing_else_is(tmp_path: Path) -> None:
    """Real processes: one that is told of its clock after it was forked, and one that it starts."""
    one, other = (host.name for host in plan_hosts("t", HostsSize(2, 2)).hosts)
    clocks = HostClocks(tmp_path / "clocks")
    environments = [dict(clocks.environment(host)) for host in (one, other)]
    ask = "import time; time.sleep(0.01); print(time.time(), time.monotonic())"
    fork = f"import os\nos.environ.update({environments[0]!r})\n{ask}"
    clocks.put(one, -600.0)
    with clocks_may_be_wrong(tmp_path):
        told = [subprocess.run([sys.executable, "-c", ask], env=os.environ | env, capture_output=True, check=True)
                for env in (environments[0], environments[1], {})]  # fmt: skip
        told.append(subprocess.run([sys.executable, "-c", fork], capture_output=True, check=True))
    day_s, steady_s = zip(*(map(float, one.stdout.split()) for one in told), strict=True)
    assert [round((time.time() - one) / 600) for one in day_s] == [1, 0, 0, 1]
    assert max(steady_s) - min(steady_s) < 60
    end = clocks.drift(one)
    end()
    assert (tmp_path / "clocks" / "host-0.clock").read_bytes() == bytes(8), "right again"


def test_what_lies_on_no_disk_cannot_be_slowed() -> None:
    with pytest.raises(LabError, match="/proc does not lie on a disk"):
        disk_of(Path("/proc"))


@pytest.mark.parametrize(
    ("regions", "hosts", "names"),
    [
        (2, 4, ["router-host", "tiles-host", "shard-host", "database-host", "partition"]),
        (1, 3, ["database-host"]),
        (2, 2, ["partition"]),
        (1, 2, []),
    ],
)
def test_without_a_choice_it_is_hurt_as_it_can_survive(regions: int, hosts: int, names: list[str]) -> None:
    assert [fault.name for fault in chosen_faults(None, plan_hosts("t", HostsSize(regions, hosts)))] == names


def test_options_are_checked() -> None:
    with pytest.raises(LabError, match="every_s must be"):
        HostsOptions(FAULTS, every_s=0.0)


def test_the_witness_never_lets_both_go_on_alone() -> None:
    """Over all sequences of five questions: from a yes for one side to its pairing the other is told no."""
    words = [(word, name) for word in ("promote", "alone", "paired") for name in ("a", "b")]
    todo: list[tuple[WitnessState, int]] = [(WitnessState("a", is_alone=False), 5)]
    seen = set()
    while todo:
        state, left = todo.pop()
        for word, name in words if left else ():
            after, granted = state.after(word, name)
            if name != state.primary:
                assert granted == (word == "promote" and not state.is_alone)
            if granted and word != "paired":
                assert after == WitnessState(name, is_alone=True)
            if not granted:
                assert after == state
            seen.add((state, word, name))
            todo.append((after, left - 1))
    assert len(seen) == 4 * len(words), "every state was asked everything"
    with pytest.raises(LabError, match="not asked 'steal'"):
        WitnessState("a").after("steal", "a")


@contextmanager
def a_witness(file: Path) -> Iterator[tuple[str, int]]:
    address, stop = ("127.0.0.1", new_port()), threading.Event()
    thread = threading.Thread(target=witness, args=(address, file, "a"), kwargs={"stop": stop})
    thread.start()
    try:
        while WitnessClient(address, "x").who() is None:
            assert thread.is_alive()
        yield address
    finally:
        stop.set()
        thread.join()


def test_the_witness_remembers_and_takes_no_nonsense(tmp_path: Path) -> None:
    file = tmp_path / "witness.json"
    with a_witness(file) as address:
        a, b = WitnessClient(address, "a"), WitnessClient(address, "b")
        assert a.who() == WitnessState("a", is_alone=True)
        assert (b.grants("promote"), a.grants("paired"), b.grants("promote")) == (False, True, True)
        assert not a.grants("alone")
        for nonsense in (b"\xff\x00\n", b"steal a\n", b"x" * 10_000 + b"\n", b""):
            with socket.create_connection(address, 5) as connection, suppress(OSError):  # it may have hung up already
                connection.sendall(nonsense)
                connection.shutdown(socket.SHUT_WR)
        assert not a.grants("steal")
        assert a.who() == WitnessState("b", is_alone=True)
    with a_witness(file) as address:
        assert WitnessClient(address, "a").who() == WitnessState("b", is_alone=True), "also over its end"
    assert json.loads(file.read_text()) == {"primary": "b", "is_alone": True}
    assert WitnessClient(address, "a").who() is None, "nobody answers there any more"
    assert not WitnessClient(None, "a").grants("promote")


def test_a_gap_is_the_longest_pause_and_lasts_up_to_the_end() -> None:
    assert longest_gap_s([1.0, 2.0, 5.0, 6.0], 0.0, 7.0) == 3.0
    assert longest_gap_s([1.0], 0.0, 10.0) == 9.0
    assert longest_gap_s([], 3.0, 7.0) == 4.0
    assert longest_gap_s([0.0, 9.0], 4.0, 10.0) == 5.0, "a pause from before counts from the fault"


def trial(acks_s: list[list[float]], *, is_cut: bool = False) -> HostTrial:
    tiles_s = [[10.5, 11.5, 12.5, 13.5, 14.5]] * len(acks_s)
    return HostTrial("x", "host-1", 10.0, 14.0, 15.0, is_cut, len(acks_s) - 1, acks_s, tiles_s, tiles_s)


def test_the_worst_region_counts_and_a_cut_one_from_when_it_is_whole() -> None:
    served, silent = [10.2, 11.0, 12.0, 13.0, 14.2], [9.0, 14.8]
    assert trial([served, silent]).ack_gap_s == pytest.approx(4.8)
    assert trial([served, silent]).back_s is None
    assert trial([served, silent], is_cut=True).ack_gap_s == pytest.approx(1.2), "the other region's"
    assert trial([served, silent], is_cut=True).back_s == pytest.approx(0.8), "its end was at 14"
    assert trial([served, [9.0]], is_cut=True).back_s == pytest.approx(1.0), "not at all until the account ends"
    assert trial([silent, served], is_cut=True).ack_gap_s == pytest.approx(4.8), "the cut one does not excuse it"
    assert trial([served, silent]).acknowledged == 6
    assert trial([served, silent]).as_dict()["tile_gap_s"] == 1.0


def test_without_bodies_acknowledgements_count_and_how_soon_tiles_and_versions_come_again() -> None:
    served, silent = [10.2, 11.0, 12.0, 13.0, 14.2], [9.0, 14.8]
    gone = replace(trial([served, served]), is_bodiless=True, tiles_s=[silent, served], versions_s=[served, [14.9]])
    assert (gone.counted_gap_s, gone.tile_gap_s) == (pytest.approx(1.2), pytest.approx(4.8))
    assert gone.back_s == pytest.approx(0.9), "the last of all regions"
    good = Findings(reports=3, acknowledged=3, versions=1, received=9, identical_map=True)
    assert outcome((gone,), good).failures == []


def test_while_a_clock_is_so_wrong_that_seals_do_not_count_reports_may_wait() -> None:
    late = trial([[9.0, 14.8], [9.0, 14.8]])
    assert late.counted_gap_s > 4.0
    waited = replace(late, is_untimely=True, tiles_s=[[9.5, 10.5, 11.5, 12.5, 13.5, 14.5]] * 2)
    assert waited.counted_gap_s <= 1.0, "tiles may not"
    assert waited.back_s == pytest.approx(14.8 - waited.ended_s)
    fault = BY_FAULT["boot-shard-host"]
    assert [fault.is_untimely(s) for s in (900.0, -600.0, 599.0)] == [True, True, False]
    assert BY_FAULT["clock-vehicles"].is_untimely(900.0)
    assert not BY_FAULT["clock-router-host"].is_untimely(900.0), "it looks at no seal"


def test_with_certificates_all_endpoints_are_private_and_everybody_has_a_name() -> None:
    plan = plan_hosts("t", HostsSize(2, 4, 1, is_secure=True))
    assert all(one.startswith("tls/198.19.") for region in (0, 1) for one in plan.routers(region))
    members = members_of(plan)
    assert len(set(members.values())) == len(members)
    parts = {part for host in plan.hosts for part in host.parts} - {*DATABASES, WITNESS}
    clients = {name for region in (0, 1) for name in client_names(plan, region)}
    assert set(members) == parts | clients | {"messenger", "fleet"}
    assert {members[one].role for one in clients} == {"vehicle"}


def outcome(trials: tuple[HostTrial, ...], findings: Findings, settled_s: float | None = 1.0) -> HostsOutcome:
    return HostsOutcome({}, {}, 1, None, trials, findings, settled_s, 4.0, False, {}, ())


def test_what_was_broken_is_named() -> None:
    served, silent = [10.2, 11.0, 12.0, 13.0, 14.2], [9.0, 14.8]
    good = Findings(reports=3, acknowledged=3, versions=1, received=9, identical_map=True)
    assert outcome((trial([served]),), good).failures == []
    assert outcome((trial([silent]),), good).failures == ["x (host-1): 4.8 s without service"]
    assert outcome((), good, None).failures == ["it did not settle"]
    bad = Findings(acknowledged=3, versions=1, received=9, lost=["one"], doubled=["two"])
    assert outcome((), bad).failures == ["1 lost", "1 doubled", "gnd map verify: {}"]


def test_times_of_clients_that_were_killed_while_they_wrote(tmp_path: Path) -> None:
    file = tmp_path / "a.times"
    file.write_text("2.5000\n1.2500\n3")
    assert read_times([file, tmp_path / "missing"]) == [1.25, 2.5]


def test_only_a_labs_folders_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(data, "DATA_ROOT", tmp_path / "labs")
    assert data.labs_with_data() == ()
    with data.data_folder("one") as folder:
        (folder / "file").touch()
        (tmp_path / "labs" / "Not a lab").mkdir()
        assert data.labs_with_data() == ("one",)
    assert not folder.exists()
    (tmp_path / "labs" / "two").symlink_to(tmp_path)
    assert data.remove_data("two") == ()
    assert tmp_path.exists()
