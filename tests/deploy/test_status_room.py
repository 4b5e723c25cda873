"""`gnd status` as operators and their monitoring use it: real stores, real programs, a real terminal."""

import json
import os
import pty
import re
import select
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from manifests import DEPLOY
from metric_names import MONITORING
from suite_ports import new_port

from gnd.deploy.run_folder import RunFolder
from gnd.deploy.status import alert_rules as rules
from gnd.deploy.status.figures import CloudFigures, DiskRoom, look_at
from gnd.deploy.status.raised import exit_code, raised_by
from gnd.deploy.status.thresholds import AlertThresholds, load_thresholds
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.router import open_router
from gnd.gnd_map.errors import ConfigError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.settings import settings_text
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.keys import traffic_key
from gnd.schemas.report_id import deterministic_report_id
from gnd.schemas.traffic import TrafficSample
from gnd.tile_store.location import StoreLocation, open_store
from gnd.tile_store.values import QueueState, ReportRow, ShardSeen, StoreConfig

TILE = TileId(497353963154)
EAST = TileId(497353963155)
T_NS = 1_700_000_000_000_000_000


def fill(location: StoreLocation) -> StoreLocation:
    """A shard that lives, a tile set aside, one that waits, a refused message, a vehicle that does not count."""
    with open_store(location, StoreConfig(merge_delay_s=0.0)) as store:
        one = np.array([1], np.int32)
        mean_m, cov_m2 = np.zeros((1, 3), np.float32), np.array([[0.01, 0, 0, 0.01, 0, 0.01]], np.float32)
        store.put_tiles([Tile(tile, 0, Gaussians(one, one * 100, one * 25, mean_m, cov_m2)) for tile in (TILE, EAST)])
        store.put_reports(
            [
                ReportRow(deterministic_report_id(n, "v1"), "ndt", tile, "v1", time.time_ns(), b"body")
                for n, tile in enumerate((TILE, EAST))
            ]
        )
        store.join("shard-0")
        claims = store.claim("shard-0", 2, 60.0)
        held = next(one for one in claims if one.tile == TILE)
        assert store.begin([held], 60.0) == [True]
        assert store.set_aside(held, "a page is damaged")
        store.quarantine(b"junk", "not a message", "gnd/v1/change/x")
        store.quarantine_vehicle("v9", "lies")
    return location


@pytest.fixture(params=["sqlite", "postgresql"])
def location(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[StoreLocation]:
    made = tmp_path / "map.sqlite" if request.param == "sqlite" else request.getfixturevalue("new_database")()
    ended = threading.Event()
    with ThreadPoolExecutor() as pool:
        beating = pool.submit(beat, fill(made), ended)
        yield made
        ended.set()
        beating.result()


def beat(location: StoreLocation, ended: threading.Event) -> None:
    """The signs of life of a shard, which is silent after 15 s without."""
    with open_store(location) as store:
        while not ended.wait(1.0):
            store.beat("shard-0", [], 60.0)


def gnd(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "gnd.deploy.cli", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


def test_a_store_is_shown_and_checked_by_the_thresholds_of_a_file(location: StoreLocation, tmp_path: Path) -> None:
    done = gnd("status", location)
    assert done.returncode == 0, done.stderr
    said = " ".join(done.stdout.split())
    for words in (
        "GndTilesSetAside: 1 tiles cannot be merged",
        "→ gnd map status says why",
        "shards shard-0",
        "acknowledged 2 report parts",
        "set aside 1 tile",
        "quarantine 1 message, 32 B",
        "vehicles not counted v9 (lies)",
        "0 versions on trial",
    ):
        assert words in said, done.stdout
    told = json.loads(gnd("status", location, "--json").stdout)
    assert (told["parts"], told["tiles_set_aside"], told["quarantine"]["bytes"]) == (2, 1, 32)
    assert [one["alert"] for one in told["alerts"]] == ["GndTilesSetAside"]
    is_file = isinstance(location, Path)
    assert (told["disk"]["free_bytes"] is not None) == is_file
    done = gnd("status", location, "--check")
    assert (done.returncode, done.stdout.split(":")[0]) == (1, "WARNING"), done.stdout + done.stderr
    file = tmp_path / "alerts.toml"
    file.write_text("tiles_set_aside = 1\n")
    done = gnd("status", location, "--check", "--alerts", file)
    assert (done.returncode, done.stdout[:13]) == (0, "OK: no alert ")
    file.write_text("tiles_set_aside = 1\ndisk_full_gb = 1e9\ndisk_low_gb = 1e9\n")
    done = gnd("status", location, "--check", "--alerts", file)
    assert done.returncode == (2 if is_file else 0)
    assert ("CRITICAL: GndDiskFull: " in done.stdout) == is_file


def test_what_is_not_there_or_not_understood_is_refused(tmp_path: Path) -> None:
    assert gnd("status", tmp_path / "absent.sqlite", "--check").returncode == 2
    (tmp_path / "alerts.toml").write_text("queue_overdu_s = 3\n")
    done = gnd("status", fill(tmp_path / "map.sqlite"), "--alerts", tmp_path / "alerts.toml")
    assert (done.returncode, done.stdout) == (2, "")
    assert "queue_overdue_s" in done.stderr
    both = gnd("status", tmp_path / "map.sqlite", "--watch", "--check")
    assert (both.returncode, "give one of them" in both.stderr) == (2, True)


FIGURES = CloudFigures(
    source="map.sqlite",
    at_ns=T_NS,
    shards=(ShardSeen("a", T_NS, 1.0),),
    tiles=2,
    parts=9,
    parts_waiting=0,
    tiles_to_merge=0,
    tiles_set_aside=0,
    queue=QueueState(0.0, 0.0, (1.0,), 0, 0),
    uploads={},
    waiting={"tiles": 0, "voxels": 0, "parked": 0, "season": 0},
    on_trial=0,
    paused=0,
    not_counted={},
    to_check=(),
    disk=DiskRoom(1000, 10**11, "/"),
    certificate_s=30 * 86400.0,
)


@pytest.mark.parametrize(
    ("change", "alerts"),
    [
        ({}, []),
        ({"shards": ()}, ["GndNoShard"]),
        ({"shards": (ShardSeen("a", T_NS, 1.0), ShardSeen("b", T_NS, 99.0))}, ["GndShardSilent"]),
        ({"shards": (ShardSeen("b", T_NS, None),)}, ["GndNoShard", "GndShardSilent"]),
        ({"queue": QueueState(60.0, 600.0, (120.0,), 0, 48_000_000)}, []),
        ({"queue": QueueState(60.1, 0.0, (), 0, 0)}, ["GndQueueOverdue"]),
        ({"queue": QueueState(0.0, 600.1, (), 0, 0)}, ["GndReportsWait"]),
        ({"queue": QueueState(0.0, 0.0, (1.0, 120.1), 0, 0)}, ["GndMergesSlow"]),
        ({"queue": QueueState(0.0, 0.0, (), 5, 48_000_001)}, ["GndQuarantineFull"]),
        ({"tiles_set_aside": 1}, ["GndTilesSetAside"]),
        ({"disk": DiskRoom(1, 4_999_999_999, "/")}, ["GndDiskLow"]),
        ({"disk": DiskRoom(1, 499_999_999, "/")}, ["GndDiskFull"]),
        ({"disk": DiskRoom(1, None)}, []),
        ({"certificate_s": 6.9 * 86400}, ["GndCertificateEndsSoon"]),
        ({"certificate_s": 35 * 3600.0}, ["GndCertificateEnds"]),
        ({"certificate_s": -1.0}, ["GndCertificateEnds"]),
        ({"certificate_s": None}, []),
    ],
    ids=str,
)
def test_each_threshold_raises_its_alert_and_no_other(change: dict[str, Any], alerts: list[str]) -> None:
    raised = raised_by(replace(FIGURES, **change), AlertThresholds())
    assert [one.alert for one in raised] == alerts
    severity = {rule["alert"]: rule["labels"]["severity"] for rule in committed_rules()}
    assert [one.severity for one in raised] == [severity[one.alert] for one in raised]
    assert exit_code(raised) == max(({"warning": 1, "critical": 2}[one.severity] for one in raised), default=0)


def committed_rules() -> list[dict[str, Any]]:
    groups = yaml.safe_load((MONITORING / "alerts.yaml").read_text())["groups"]
    return [rule for group in groups for rule in group["rules"]]


def test_rules_and_defaults_that_are_committed_are_what_the_file_gives() -> None:
    file = DEPLOY / "monitoring" / "alerts.toml"
    assert file.read_text() == settings_text(AlertThresholds())
    assert load_thresholds(file) == AlertThresholds()
    made = gnd("config", "alerts", file, "--rules")
    assert made.stdout == (MONITORING / "alerts.yaml").read_text(), "gnd config alerts FILE --rules > alerts.yaml"
    assert json.loads(gnd("config", "alerts", "--json").stdout)["quarantine_mb"] == 48.0


def test_every_threshold_is_in_the_rules_and_changes_them(tmp_path: Path) -> None:
    usual = rules.alert_rules(AlertThresholds())
    for one in fields(AlertThresholds):
        value = getattr(AlertThresholds(), one.name)
        changed = replace(AlertThresholds(), **{one.name: value + 1 if isinstance(value, int) else value * 0.5})
        made = rules.alert_rules(changed)
        assert made != usual, f"{one.name} is in no rule"
        assert len(yaml.safe_load(made)["groups"]) == 3
    for text, why in (
        ("queue_overdue_s = 0", "outside"),
        ("disk_full_gb = 6", "above disk_low_gb"),
        ("certificate_hours = 200", "above certificate_days"),
        ("nonsense = 1", "nonsense"),
        ("merge_lag_s = 'x'", "merge_lag_s"),
    ):
        (tmp_path / "alerts.toml").write_text(text)
        with pytest.raises(ConfigError, match=why):
            load_thresholds(tmp_path / "alerts.toml")


class Terminal:
    """A program in a terminal of its own; what it shows so far."""

    def __init__(self, *words: object) -> None:
        self.pid, self.number = pty.fork()
        if self.pid == 0:
            os.environ |= {"TERM": "xterm-256color", "COLUMNS": "150", "LINES": "50"}
            os.execv(sys.executable, [sys.executable, "-m", "gnd.deploy.cli", *map(str, words)])
        self.shown = ""

    def until(self, pattern: str, most_s: float = 60.0) -> None:
        end_s = time.monotonic() + most_s
        while not re.search(pattern, self.shown):
            assert time.monotonic() < end_s, f"not shown within {most_s} s: {pattern}\n{self.shown}"
            if select.select([self.number], [], [], 0.2)[0]:
                self.shown += re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", os.read(self.number, 65536).decode())

    def ended(self, most_s: float = 20.0) -> int:
        """Its exit code."""
        end_s = time.monotonic() + most_s
        while time.monotonic() < end_s:
            with_output = select.select([self.number], [], [], 0.1)[0]
            if with_output:
                with suppress(OSError):  # the terminal's other end is closed
                    os.read(self.number, 65536)
            pid, code = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                return os.waitstatus_to_exitcode(code)
        raise AssertionError(f"it has not ended within {most_s} s")


@contextmanager
def terminal(*words: object) -> Iterator[Terminal]:
    one = Terminal(*words)
    try:
        yield one
    finally:
        with_child = True
        try:
            os.kill(one.pid, signal.SIGKILL)
            os.waitpid(one.pid, 0)
        except (ProcessLookupError, ChildProcessError):
            with_child = False
        os.close(one.number)
        assert not with_child, "it had to be killed"


@pytest.mark.parametrize("end", ["q", "Ctrl-C", "SIGTERM"])
def test_a_view_in_a_terminal_follows_the_store_and_ends_cleanly(tmp_path: Path, end: str) -> None:
    path = fill(tmp_path / "map.sqlite")
    with terminal("status", path, "--watch", "--every", "0.2") as shown:
        shown.until(r"shards +shard-0")
        shown.until("q or Ctrl-C ends")
        assert not termios.tcgetattr(shown.number)[3] & termios.ICANON
        with open_store(path) as store:
            store.quarantine(b"more", "not a message")
        shown.until(r"quarantine +2 messages, 49 B")
        if end == "SIGTERM":
            os.kill(shown.pid, signal.SIGTERM)
        else:
            os.write(shown.number, {"q": b"q", "Ctrl-C": b"\x03"}[end])
        assert shown.ended() == 0
        assert termios.tcgetattr(shown.number)[3] & termios.ICANON, "the terminal is as it was"


def test_a_store_that_does_not_answer_is_said_and_asked_again(new_database: Callable[[], str], postgres: Any) -> None:
    url = str(fill(new_database()))
    name = url.partition("?")[0].rpartition("/")[2]
    command = [sys.executable, "-m", "gnd.deploy.cli", "status", url, "--watch", "--json", "--every", "0.2"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        assert json.loads(process.stdout.readline())["parts"] == 2
        postgres.sql(f"ALTER DATABASE {name} ALLOW_CONNECTIONS false")
        postgres.sql(f"SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = '{name}'")
        while "error" not in (line := json.loads(process.stdout.readline())):
            pass
        assert name in line["error"]
        postgres.sql(f"ALTER DATABASE {name} ALLOW_CONNECTIONS true")
        while "parts" not in (line := json.loads(process.stdout.readline())):
            pass
        assert line["parts"] == 2
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=30)
        assert (process.returncode, err) == (0, "")
    finally:
        process.kill()
        process.wait()


def test_a_look_changes_nothing(tmp_path: Path) -> None:
    path = fill(tmp_path / "map.sqlite")
    assert isinstance(path, Path)
    before = path.read_bytes()
    with open_store(path, create=False, read_only=True) as store:
        assert look_at(store, path).parts == 2
    assert path.read_bytes() == before


def test_vehicles_of_a_run_are_heard_over_its_router(tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "run")
    run.root.mkdir()
    fill(run.store)
    endpoint = f"tcp/127.0.0.1:{new_port()}"
    run.endpoint.write_text(f"{endpoint}\n")
    run.pids.write_text(json.dumps({"router": os.getpid()}))  # the router below is in this process
    sample = TrafficSample("car-7", time.time_ns(), 512.0, (), 0, 0, 0.65, 2.2, "degraded", 3, 2)
    command = [sys.executable, "-m", "gnd.deploy.cli", "status", str(run.root), "--watch", "--json", "--every", "0.2"]
    with (
        open_router([endpoint]),
        open_bus(BusConfig(connect=(endpoint,)), name="car-7") as bus,
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process,
    ):
        assert process.stdout is not None
        try:
            bus.publish(traffic_key("car-7"), b"no sample", kind="telemetry")  # is noted and left out
            for line in process.stdout:
                bus.publish(traffic_key("car-7"), sample.encode(), kind="telemetry")
                if vehicles := json.loads(line)["vehicles"]:
                    break
            assert vehicles == [{"vehicle": "car-7", "health": "degraded", "reports": 2}]
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=60) == 0
        finally:
            process.kill()
    run.summary.write_text("{}")  # it has ended: nobody is listened to, the store is shown all the same
    told = json.loads(gnd("status", run.root, "--json").stdout)
    assert (told["vehicles"], told["parts"]) == ([], 2)
