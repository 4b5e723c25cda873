"""A store with a version on trial, and vehicles that tell how they fare on it."""

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.release.collector import HealthCollector
from gnd.cloud_merger.release.parameters import ReleaseParameters
from gnd.cloud_merger.work import Worker
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.health import HealthReport, TileHealth
from gnd.schemas.keys import change_key, health_key
from gnd.schemas.ticket import ticket_of
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.trials import Arm, VersionTrial

from merger_world import GROUND, TILE, VOXEL_BY_VOXEL, WALL, gaussians_of  # isort: skip
from merger_world import POLE, State, change_of, report_of  # isort: skip
from upload_desk import Desk  # isort: skip

STATES: dict[int, State] = {0: GROUND, 1: WALL}
BASE = gaussians_of(STATES)
KEY = change_key("ndt", TILE.district)
HALF = ReleaseParameters(share=0.5)
START_NS = 1_800_000_000_000_000_000


def worker_of(store: SqliteStore, release: ReleaseParameters = HALF) -> Worker:
    return Worker(store, ShardConfig(store_path=store.path, confirmation=VOXEL_BY_VOXEL, release=release))


def merge_all(store: SqliteStore, worker: Worker) -> None:
    while claims := store.claim("one", 16, 30.0):
        store.publish(worker.merge(claims))


def reported(store: SqliteStore, number: int, vehicle: str = "", changed=None, base=BASE, version=1, tile=TILE) -> str:
    """A report of a pole at voxel 2, looked at and in the journal."""
    changed = {2: POLE} if changed is None else changed
    report = report_of(number, change_of(base, [0, 1, 2, 3], changed, tile=tile, version=version), vehicle=vehicle)
    assert Desk(store).send(KEY, report.encode()).status == "released"
    return report.report_id


def on_trial(store: SqliteStore, tile: TileId = TILE) -> VersionTrial:
    return store.trials("ndt")[tile]


def cars_of(trial: VersionTrial, arm: Arm, count: int, prefix: str = "car") -> list[str]:
    """Names of vehicles that are to have one of the versions."""
    names, number = list[str](), 0
    while len(names) < count:
        name = f"{prefix}-{number}"
        number += 1
        if trial.is_among_first(ticket_of(name)) == (arm == "new"):
            names.append(name)
    return names


def visit(trial: VersionTrial, arm: Arm, **said) -> TileHealth:
    """What a vehicle tells that drove through: all is well unless it says otherwise."""
    version = trial.version if arm == "new" else trial.base_version
    usual = {"scans": 20, "matched_permille": 900, "fit_permille": 800, "elsewhere_permille": 800}
    return TileHealth(trial.tile, version, **{**usual, "inside": 15, "left": True, **said})


def payload(told: TileHealth, t_ns: int = START_NS) -> bytes:
    return HealthReport("ndt", told.tile.district, t_ns, (told,)).encode()


class Listener:
    """A shard's collector without its bus."""

    def __init__(self, store: SqliteStore) -> None:
        self.collector = HealthCollector(store)

    def hear(self, car: str, told: TileHealth, t_ns: int = START_NS) -> None:
        self.collector.take(health_key(car), payload(told, t_ns))

    def hear_all(self, trial: VersionTrial, arm: Arm, fits: list[int], prefix: str = "car") -> list[str]:
        """One vehicle for each fit (1/1000)."""
        cars = cars_of(trial, arm, len(fits), prefix)
        for car, fit in zip(cars, fits, strict=True):
            self.hear(car, visit(trial, arm, fit_permille=fit))
        return cars
