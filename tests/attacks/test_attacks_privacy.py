"""Who wants to know where somebody lives: reads all that the cloud keeps, and all that goes over the bus."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from identity_scene import router_process, until
from suite_ports import new_port
from ulid import ULID

from gnd.deploy.certs_cli import certs
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.identity.authority import Authority
from gnd.fleet_bus.identity.names import MemberName
from gnd.fleet_bus.identity.pseudonyms import issue_pseudonyms, present_pseudonym, whose
from gnd.fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.street import StreetOptions, street
from gnd.gnd_map.geodesy import LocalFrame
from gnd.schemas.changes import ChangeReport
from gnd.schemas.drive import ReferencePose
from gnd.schemas.drive_mcap import read_drive, read_header
from gnd.schemas.keys import traffic_keys
from gnd.schemas.traffic import TrafficSample
from gnd.tile_store.build import build_map
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.config import PRIVATE_OFF, PRIVATE_SEEN_M
from gnd.vehicle_agent.surroundings import tile_distance_m

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

HOLDER = "the-car-of-anna-k"
RADIUS_M = 20.0
LEAST_M = (1 - PRIVATE_OFF) * RADIUS_M + PRIVATE_SEEN_M
GND = (sys.executable, "-m", "gnd.deploy.cli")


@dataclass
class Trips:
    """A vehicle with pseudonyms that has driven one street twice, under two names, and what others have of it."""

    folder: Path
    authority: Authority
    names: list[str] = field(default_factory=list)
    results: list[dict[str, object]] = field(default_factory=list)
    samples: list[TrafficSample] = field(default_factory=list)

    @property
    def pseudonyms(self) -> Path:
        return self.folder / "pseudonyms"

    @property
    def store(self) -> Path:
        return self.folder / "map.sqlite"

    def told(self, name: str) -> list[ChangeReport]:
        """The rows of the cloud's journal under a name."""
        with SqliteStore(self.store) as store:
            return [ChangeReport.decode(row.body) for row in store.reports("ndt", name)]

    def drive(self, endpoint: str) -> None:
        """One trip, as a process of its own."""
        self.names.append(json.loads((present_pseudonym(self.pseudonyms) / "name.json").read_text()))
        command = [*GND, "agent", "--drive", str(self.folder / "trip.mcap"), "--connect", endpoint]
        command += ["--work-dir", str(self.folder / "vehicle"), "--identity", str(self.pseudonyms)]
        command += ["--set", f"report.private_m={RADIUS_M}"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
        assert done.returncode == 0, done.stderr
        self.results.append(json.loads((self.folder / "vehicle" / "result.json").read_text()))


def issue(trips: Trips) -> None:
    """The pseudonym of the present period, a new one if there was one before; its name lies beside."""
    if trips.pseudonyms.exists():
        shutil.rmtree(present_pseudonym(trips.pseudonyms))
    (entry,) = issue_pseudonyms(trips.authority, HOLDER, trips.pseudonyms, count=1)
    (present_pseudonym(trips.pseudonyms) / "name.json").write_text(json.dumps(entry.name))
    trips.authority.copy_lists([trips.folder / "router"])


@contextmanager
def part(*command: str) -> Iterator[None]:
    """A process of the cloud."""
    with subprocess.Popen([*GND, *command], stdout=subprocess.DEVNULL, env=dict(os.environ)) as process:
        try:
            yield
        finally:
            process.terminate()
            process.wait(30)


@pytest.fixture(scope="module")
def trips(tmp_path_factory: pytest.TempPathFactory) -> Trips:
    """Router, tile server and shard as processes, with rights; two trips of a vehicle, each under another name."""
    folder = tmp_path_factory.mktemp("privacy")
    world = street(11, StreetOptions(length_m=260.0))
    simulate_drive(
        world, DriveConfig("mapper", "VLP-16", state="before", errors=PERFECT, cruise_mps=20.0), folder / "map.mcap"
    )
    simulate_drive(world, DriveConfig("trip", "VLP-16", seed=4, cruise_mps=20.0), folder / "trip.mcap")
    authority = Authority.create(folder / "authority", "tests")
    for member, name in (("router.main", "router"), ("tiles.store", "store"), ("shard.s", "s"), ("operator.o", "o")):
        authority.issue(MemberName.parse(member), folder / name)
    authority.copy_lists([folder / "router"])
    made = Trips(folder, authority)
    with SqliteStore(made.store, signing=Signing(folder / "o")) as store:
        build_map([folder / "map.mcap"], store)
    endpoint = f"tls/127.0.0.1:{new_port()}"
    issue(made)
    with ExitStack() as stack:
        stack.enter_context(router_process(folder / "router", endpoint))
        bus = stack.enter_context(open_bus(BusConfig(connect=(endpoint,), identity=folder / "o"), name="o"))
        samples = made.samples
        bus.subscribe(traffic_keys(), lambda _k, body: samples.append(TrafficSample.decode(body)), kind="control")
        reached = ("--connect", endpoint, "--identity")
        stack.enter_context(part("store", "--path", str(made.store), *reached, str(folder / "store")))
        stack.enter_context(part("merger", "--id", "s", "--store", str(made.store), *reached, str(folder / "s")))
        made.drive(endpoint)
        issue(made)
        assert until(lambda: made.authority.entries()[-1].name != made.names[0])
        made.drive(endpoint)
    return made


def places(trips: Trips) -> tuple[LocalFrame, list[np.ndarray]]:
    """Where the trip truly began and ended, (3,) each in a frame."""
    frame = read_header(trips.folder / "trip.mcap").anchor
    way = [one for one in read_drive(trips.folder / "trip.mcap") if isinstance(one, ReferencePose)]
    return frame, [way[0].T_map_vehicle[:3, 3], way[-1].T_map_vehicle[:3, 3]]


def test_the_vehicle_has_driven_and_reported_under_two_names(trips: Trips) -> None:
    """What the attacks below look at."""
    assert len(set(trips.names)) == 2
    for name, result in zip(trips.names, trips.results, strict=True):
        assert result["vehicle"] == name
        assert result["reports_acknowledged"] == result["reports_sent"] >= 1
        assert len(trips.told(name)) >= 2, "tiles in the middle of the street"
    assert [whose(trips.authority, name) for name in trips.names] == [HOLDER, HOLDER]


def test_attack_the_store_is_read_for_names(trips: Trips) -> None:
    """Somebody has the store's file, with its log: no byte of it names the vehicle, nor do the lists of the router."""
    files = [*trips.folder.glob("map.sqlite*"), *(trips.folder / "router").iterdir()]
    read = b"".join(path.read_bytes() for path in files)
    assert trips.names[0].encode() in read
    assert HOLDER.encode() not in read
    assert HOLDER.encode() not in (trips.authority.folder / "register.jsonl").read_bytes()


def test_attack_whose_pseudonym_without_the_key(trips: Trips, tmp_path: Path) -> None:
    """Somebody has the register, but not the authority's key: `gnd certs whose` cannot say."""
    other = Authority.create(tmp_path / "other", "other")
    shutil.copy(trips.authority.folder / "register.jsonl", other.folder / "register.jsonl")
    asked = CliRunner().invoke(certs, ["whose", trips.names[0], "--authority", str(other.folder)])
    assert asked.exit_code != 0
    assert "another key" in str(asked.exception)


def test_attack_where_trips_begin_and_end(trips: Trips) -> None:
    """All tiles of all reports are looked at: none lies near the begin or the end of a trip, although it was driven."""
    frame, ends = places(trips)
    for name in trips.names:
        tiles = {change.tile for report in trips.told(name) for change in report.tiles}
        assert all(tile_distance_m(frame, tile, end) > LEAST_M for tile in tiles for end in ends)
        assert trips.results[trips.names.index(name)]["private"]


def test_attack_gaps_of_many_trips_are_laid_over_each_other(trips: Trips) -> None:
    """A second trip under another name leaves the same gaps: circles are remembered, their centres are not homes."""
    told = [{change.tile for one in trips.told(name) for change in one.tiles} for name in trips.names]
    circles = json.loads((trips.pseudonyms / "private_places.json").read_text())
    assert len(circles) == 2, "begin and end, of both trips"
    frame, _ends = places(trips)
    hidden = [frame.enu_from_geodetic(one["lat_rad"], one["lon_rad"], 0.0).reshape(3) for one in circles]
    reach_m = RADIUS_M + PRIVATE_SEEN_M
    assert all(tile_distance_m(frame, tile, one) > reach_m for tiles in told for tile in tiles for one in hidden)


def test_attack_positions_in_telemetry(trips: Trips) -> None:
    """An operator hears what vehicles say of themselves: of one with private places no position is among it."""
    assert {one.vehicle for one in trips.samples} == set(trips.names)
    assert not any(one.has_position for one in trips.samples)


def test_attack_when_trips_begin(trips: Trips) -> None:
    """Report ids and times of first scans are looked at: they tell the hour in which a trip began, no more."""
    hour_ms = 3_600_000
    with SqliteStore(trips.store) as store:
        rows = [row for name in trips.names for row in store.reports("ndt", name)]
    assert {int(ULID.from_str(row.report_id).milliseconds) % hour_ms for row in rows} == {0}
    assert {ChangeReport.decode(row.body).first_ns // 1_000_000 % hour_ms for row in rows} == {0}


def test_attack_a_map_of_circles_is_looked_for_in_the_cloud(trips: Trips) -> None:
    """The vehicle's own list of private places would tell all: nothing of it leaves the vehicle."""
    circles = json.loads((trips.pseudonyms / "private_places.json").read_text())
    read = b"".join(path.read_bytes() for path in trips.folder.glob("map.sqlite*"))
    numbers = [np.float64(one[name]).tobytes() for one in circles for name in ("lat_rad", "lon_rad")]
    assert not [number for number in numbers if number in read or number[::-1] in read]
    assert (trips.pseudonyms / "private_places.json").stat().st_mode & 0o077 == 0


def test_tiles_are_deleted_from_no_map(trips: Trips) -> None:
    """What is kept back costs the map nothing: versions of tiles at begin and end are those of the first map."""
    frame, ends = places(trips)
    with SqliteStore(trips.store) as store:
        near = [one for one in store.heads("ndt") if any(tile_distance_m(frame, one.tile, end) < 30 for end in ends)]
    assert near
    assert {one.version for one in near} == {1}
