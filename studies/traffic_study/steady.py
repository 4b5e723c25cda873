"""What a vehicle sends and receives on a street that it knows: every byte of the wire, over the real bus.

Router, tile server and merger are processes of their own, as in a fleet run; the vehicle is an agent that drives at the
pace of the recording, so that keep-alives are those of as long a drive. Its cache holds the map when it starts. What is
counted is what the kernel counted on its connection.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from gnd.deploy import roles
from gnd.deploy.fleet import cloud_processes
from gnd.deploy.fleet_config import FleetConfig
from gnd.deploy.fleet_identities import make_identities
from gnd.deploy.processes import ProcessSpec, Supervisor, start_fork_server
from gnd.deploy.run_folder import RunFolder, create_run_folder
from gnd.deploy.site import loopback_site
from gnd.fleet_bus.ledger_file import read_ledger
from gnd.fleet_bus.remembered import FILE, RememberedChains
from gnd.fleet_bus.seal_keys import load_signer
from gnd.fleet_bus.traffic import AgentTraffic, agent_traffic, headline, per_km
from gnd.fleet_sim.drives import DriveConfig, simulate_drive
from gnd.fleet_sim.sensors import SHORT_NAMES
from gnd.fleet_sim.street import StreetOptions
from gnd.fleet_sim.traffic import Traffic
from gnd.fleet_sim.world import read_world
from gnd.gnd_map.codec import LATTICES, snap
from gnd.gnd_map.tile import Tile
from gnd.tile_store.signatures import sign_unsigned
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import DEFAULT_LAYER
from gnd.vehicle_agent.agent import AgentConfig
from gnd.vehicle_agent.link.cache import TileCache
from studies.frame.command import Bench, StudyReport, study
from studies.frame.errors import OptionError, ReproduceError
from studies.frame.options import check, option
from studies.frame.tables import Sheet, sheet_of, shown
from studies.simulation.base_map import read_base
from studies.simulation.options import RunOptions
from studies.simulation.worlds import WorldFiles, prepare_world, world_name

MUST_KB_PER_KM: Final = 2.0
AIM_KB_PER_KM: Final = 1.0
_ONCE_A_DRIVE: Final = ("opening", "closing", "session", "control")
"""What a connection costs, however long it is: handshakes, declarations, certificates of the cloud's parts."""
_VEHICLE: Final = "vehicle-00"
_LOOK_S: Final = 0.5
_SETTLE_S: Final = 1.0


@dataclass(frozen=True, slots=True)
class SteadyOptions:
    """One drive of a vehicle that knows the street; nothing of it has changed since it was mapped."""

    seed: int = option(201, "Seed of the world.", "--seed", "--world-seed")
    length_m: float = option(1000.0, "Length of the street, metres.", "--length")
    parking: float = option(0.0, "Share of parking slots that are taken; on the map none.")
    speed_kmh: float = option(40.0, "Of the vehicle once under way, km/h.", "--speed")
    sensor: str = option("vlp16", "Of the vehicle.", known=SHORT_NAMES)
    link: str = option("4g", "Profile of its link.")
    pace: float = option(1.0, "Times real time; a slower pace has more keep-alives a km.")
    secure: bool = option(False, "With certificates, TLS and rights on the bus.")
    met: bool = option(False, "With --secure: vehicle and cloud have met before, and kept each other's certificates.")
    deadline_s: float = option(1800.0, "The drive is given up after so many seconds.", "--deadline")

    def __post_init__(self) -> None:
        check(self)
        if not (self.speed_kmh > 0 and self.pace > 0 and self.deadline_s > 0):
            raise OptionError(
                f"speed, pace, deadline must be positive: {self.speed_kmh} km/h, {self.pace}, {self.deadline_s} s"
            )


@study(SteadyOptions, out="runs/reproduce-steady", jobs=1)
def steady_vehicle(options: SteadyOptions, bench: Bench) -> StudyReport:
    """All bytes of a vehicle that knows its street, up and down, over the real bus.

    Nothing has changed since the street was mapped, and the vehicle's cache holds the map. Counted is what the kernel
    counted on its connection (TCP_INFO): reports, telemetry, keep-alives, acknowledgements, handshakes, everything.
    """
    found = steady(options, bench.folder.root)
    return StudyReport(found, [sheet_of_account(found)])


def steady(options: SteadyOptions, home: Path) -> dict[str, Any]:
    """Make street, map and drive (kept in `home`), drive, and return the account.

    Raises:
        GndError: something cannot be made as asked, or the drive did not come to its end.
    """
    start_fork_server()  # before any thread of this process
    drive, base = _prepared(options, home)
    folder = create_run_folder(home / "run", overwrite=True)
    folder.write_mark({"steady": str(options)})
    _fill_store_and_cache(folder, base)
    started_s = time.monotonic()
    _drive(options, folder, drive)
    traffic = agent_traffic(read_ledger(folder.ledger / f"{_VEHICLE}.jsonl"), ())
    return account(traffic, time.monotonic() - started_s)


def account(traffic: AgentTraffic, wall_s: float) -> dict[str, Any]:
    """The account of a drive as plain values, and what of it is reached.

    Must and aim hold for a vehicle under way: what comes once a drive, however long, is told by itself.
    """
    total = headline((traffic,))
    once_a_drive = sum(line.wire_bytes for line in traffic.lines if line.kind in _ONCE_A_DRIVE)
    under_way = total["other_kB_per_km"] - per_km(once_a_drive, traffic.drive_km)
    return {
        "km": round(traffic.drive_km, 4),
        "drive_s": round(traffic.drive_s, 1),
        "wall_s": round(wall_s, 1),
        **total,
        "once_a_drive_bytes": once_a_drive,
        "under_way_kB_per_km": under_way,
        "under_way_with_tiles_kB_per_km": under_way + total["tiles_kB_per_km"],
        "estimated_wire_bytes": traffic.estimated_wire_bytes,
        "rows": [
            {
                "kind": line.kind,
                "direction": line.direction,
                "messages": line.messages,
                "app_bytes": line.app_bytes,
                "wire_bytes": line.wire_bytes,
                "wire_kB_per_km": round(per_km(line.wire_bytes, traffic.drive_km), 4),
            }
            for line in traffic.lines
        ],
        "must_kB_per_km": MUST_KB_PER_KM,
        "aim_kB_per_km": AIM_KB_PER_KM,
        "met": under_way <= MUST_KB_PER_KM,
        "aim_met": under_way <= AIM_KB_PER_KM,
    }


def sheet_of_account(found: dict[str, Any]) -> Sheet:
    """An account as a table."""
    columns = {"messages": "{messages}", "B": "{wire_bytes}", "kB/km": "{wire_kB_per_km:.3f}"}
    rows = {f"{row['kind']}, {row['direction']}": row for row in found["rows"]}
    title = "{km:.3f} km in {drive_s:.0f} s of driving ({wall_s:.0f} s by the clock)"
    table = sheet_of(shown(title, found), columns, rows)
    reached = "aim met" if found["aim_met"] else "must met" if found["met"] else "missed"
    table.notes += [
        shown(
            "all bytes {all_kB_per_km:.2f} kB/km, tiles {tiles_kB_per_km:.2f}; under way, tiles included,"
            " {under_way_with_tiles_kB_per_km:.2f}",
            found,
        ),
        shown(
            "all but tiles: {other_kB_per_km:.2f} kB/km of this drive, of it once a drive (opening, declaring, closing)"
            " {once_a_drive_bytes} B",
            found,
        ),
        f"all but tiles, under way: {found['under_way_kB_per_km']:.2f} kB/km"
        f" (must {MUST_KB_PER_KM:g}, aim {AIM_KB_PER_KM:g}: {reached})",
    ]
    return table


def _prepared(options: SteadyOptions, home: Path) -> tuple[Path, WorldFiles]:
    """The drive and the map, made where they are missing."""
    street = StreetOptions(options.length_m, "wangsimni", edit_share=0.0)
    files = WorldFiles(home / world_name(options.seed, street), "surveyed")
    files.home.mkdir(parents=True, exist_ok=True)
    prepare_world(files, options.seed, RunOptions(seeds=(options.seed,), street=street, base="surveyed"))
    config = DriveConfig(
        vehicle=_VEHICLE,
        sensor=SHORT_NAMES[options.sensor],
        seed=1_000_003 * options.seed,
        cruise_mps=options.speed_kmh / 3.6,
        car_share=options.parking,
        traffic=Traffic.urban(),
    )
    drive = files.home / f"{options.sensor}-{options.speed_kmh:g}kmh-parking{100 * options.parking:g}.mcap"
    if not drive.exists():
        simulate_drive(read_world(files.world), config, drive)
    return drive, files


def _fill_store_and_cache(folder: RunFolder, files: WorldFiles) -> None:
    """The cloud holds the map as it is published, and so does the vehicle."""
    base = read_base(files.base)
    with SqliteStore(folder.store) as store:
        store.put_tiles(Tile(i, 1, snap(gaussians, LATTICES["standard"])) for i, gaussians in base.tiles.items())
        cache = TileCache[Tile](folder.agents / _VEHICLE / "cache.sqlite", DEFAULT_LAYER)
        for entry in store.heads(DEFAULT_LAYER):
            stored = store.get(DEFAULT_LAYER, entry.tile)
            if stored is not None:
                cache.put(stored.decode_gaussians())
        cache.close()


def _drive(options: SteadyOptions, folder: RunFolder, drive: Path) -> None:
    config = FleetConfig(agents=1, shards=1, link=options.link)
    identities = make_identities(folder.root, 1, 1) if options.secure else None
    if identities is not None and options.met:
        _introduce(identities)
    site = loopback_site(config, 1, identities)
    agent = AgentConfig(
        vehicle=_VEHICLE,
        drive=drive,
        work_dir=folder.agents / _VEHICLE,
        connect=(site.connect,),
        link=options.link,
        pace=options.pace,
        ledger_dir=folder.ledger,
    )
    if site.identities is not None:
        with SqliteStore(folder.store, signing=Signing(site.identities / "fleet")) as store:
            sign_unsigned(store)
    with _supervised(folder) as supervisor:
        for spec in cloud_processes(config, folder, site):
            supervisor.start(spec)
        vehicle = ProcessSpec(_VEHICLE, roles.agent, (agent,), restart=False, identity=site.identity_of(_VEHICLE))
        time.sleep(_SETTLE_S)
        supervisor.start(vehicle)
        deadline_s = time.monotonic() + options.deadline_s
        while not supervisor.finished(_VEHICLE):
            if time.monotonic() > deadline_s:
                raise ReproduceError(f"the drive did not end within {options.deadline_s:g} s: read {folder.logs}")
            supervisor.poll()
            time.sleep(_LOOK_S)


def _introduce(identities: Path) -> None:
    """The vehicle and the parts of the cloud know each other's certificates, as after an earlier drive."""
    cloud = ("store", "merger-0")
    for knows, known in ((_VEHICLE, cloud), *((part, (_VEHICLE,)) for part in cloud)):
        chains = RememberedChains(identities / knows / FILE)
        for signer in (load_signer(identities / one) for one in known):
            chains.add(signer.certificate_id, signer.chain)


@contextmanager
def _supervised(folder: RunFolder) -> Iterator[Supervisor]:
    """The vehicle ends first, the router last."""
    supervisor = Supervisor(folder.logs, folder.pids)
    try:
        yield supervisor
    finally:
        names = tuple(supervisor.pids())
        for group in ("vehicle-", "merger-", "watcher", "store", "router"):
            supervisor.stop(tuple(name for name in names if name.startswith(group)))
