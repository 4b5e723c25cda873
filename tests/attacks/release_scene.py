"""A cloud with staged releases: a real router, two shard processes, a tile server; vehicles that ask and tell."""

import itertools
import sys
import time
from collections.abc import Callable
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "cloud_merger"))

from merger_processes import FAST, TAKEN, Cloud
from merger_processes import wait_for as wait_until
from merger_world import GROUND, POLE, TILE, WALL, State, change_of, gaussians_of, report_of, tile_of_states

from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.health import HealthReport, TileHealth
from gnd.schemas.keys import health_key
from gnd.schemas.ticket import ticket_of
from gnd.tile_client.exchange import Exchange, TilesInMemory
from gnd.tile_store import sql_trials as trials
from gnd.tile_store.released import released
from gnd.tile_store.server import TileServer
from gnd.tile_store.trials import Arm, TrialState, VersionTrial

SHARDS = ("left", "right")
WARM_S = 120.0
"""A shard that has just started compiles or loads its kernels, on a busy machine for long."""
STATES: dict[int, State] = {0: GROUND, 1: WALL}
BASE = gaussians_of(STATES)
SHIFTED_WALL: State = (-0.3, 0.0, 0.0, 0.02, 0.28, 0.28)
# One tile in each of many districts, so that both shards own some and no test meets another's.
PLACES = [TileId((TILE.morton & ~1023) + k * 1024 + 5) for k in range(24)]


def wait_for(what: str, condition: Callable[[], object]) -> None:
    """Until the condition holds; a busy machine is slow."""
    wait_until(what, condition, WARM_S)


class ReleaseCloud(Cloud):
    """See the module's head."""

    def __init__(self, folder: Path, port: int) -> None:
        super().__init__(folder, port)
        self.config_path.write_text(FAST + "\n[release]\nshare = 0.5\n")
        self._numbers, self._places, self._clock = itertools.count(1), iter(PLACES), itertools.count(time.time_ns())

    def open(self) -> None:
        super().open()
        self.store.put_tiles([tile_of_states(STATES, tile) for tile in PLACES])
        self.vehicles = open_bus(BusConfig(connect=(self.endpoint,)), name="vehicles")
        self.server_bus = open_bus(BusConfig(connect=(self.endpoint,)), name="store")
        self.server = TileServer(self.store, self.server_bus).start()

    def close(self) -> None:
        self.server.close()
        self.server_bus.close()
        self.vehicles.close()
        super().close()

    def place(self) -> TileId:
        """A tile that no other test has."""
        return next(self._places)

    def report(self, tile: TileId, cars: list[str], changed: dict[int, State | None], version: int = 1) -> None:
        """Each of these vehicles reports this of a tile, and the shards have looked at it."""
        for car in cars:
            change = change_of(BASE, [0, 1, 2], changed, tile=tile, version=version)
            ack = self.send(report_of(next(self._numbers), change, vehicle=car))
            assert ack.status in TAKEN, ack
        is_done = lambda: "waiting" not in self.store.upload_counts().by_state  # noqa: E731
        wait_for("the reports are looked at", is_done)

    def trial(self, tile: TileId, cars: list[str], changed: dict[int, State | None], version: int = 1) -> VersionTrial:
        """The version that goes on trial when these vehicles have reported."""
        self.report(tile, cars, changed, version)
        wait_for("a version is on trial", lambda: tile in self.store.trials("ndt"))
        return self.store.trials("ndt")[tile]

    def poisoned(self, tile: TileId) -> VersionTrial:
        """A wall that colluding vehicles have moved, on trial."""
        return self.trial(tile, [f"colluder-{tile.morton}-{k}" for k in range(3)], {1: SHIFTED_WALL})

    def good(self, tile: TileId) -> VersionTrial:
        """A pole that is there, on trial."""
        return self.trial(tile, [f"honest-{tile.morton}-{k}" for k in range(3)], {2: POLE})

    def cars(self, trial: VersionTrial, arm: Arm, count: int, prefix: str = "car") -> list[str]:
        """Vehicles that are to have one of the versions."""
        names = (f"{prefix}-{k}" for k in itertools.count())
        of_arm = (name for name in names if trial.is_among_first(ticket_of(name)) == (arm == "new"))
        return list(itertools.islice(of_arm, count))

    def tell(self, car: str, told: TileHealth, t_ns: int | None = None) -> None:
        """Over the bus, as the agent does."""
        t_ns = next(self._clock) if t_ns is None else t_ns
        report = HealthReport("ndt", told.tile.district, t_ns, (told,))
        self.put(car, report.encode())

    def put(self, car: str, payload: bytes) -> None:
        """Any bytes on a vehicle's health key."""
        self.vehicles.publish(health_key(car), payload, kind="telemetry")

    def fare(self, trial: VersionTrial, arm: Arm, fits: list[int], prefix: str = "car") -> list[str]:
        """Vehicles of an arm drive through and tell, one for each fit (1/1000)."""
        cars = self.cars(trial, arm, len(fits), prefix)
        for car, fit in zip(cars, fits, strict=True):
            self.tell(car, visit(trial, arm, fit_permille=fit))
        return cars

    def others_fare_well(self, trial: VersionTrial) -> None:
        """Thirty vehicles on the version before, and the shard has heard them."""
        self.fare(trial, "old", [780 + k for k in range(30)])
        wait_for("the others are heard", lambda: self.heard(trial, "old") >= 30 or not self.is_open(trial))

    def heard(self, trial: VersionTrial, arm: Arm) -> int:
        """Vehicles of an arm of which the store holds something."""
        return sum(one.arm == arm for one in self.store.look(lambda c: trials.health(c, trial)))

    def is_open(self, trial: VersionTrial) -> bool:
        return trial.tile in self.store.trials("ndt")

    def state(self, trial: VersionTrial) -> TrialState:
        known = self.store.look(lambda c: trials.of_tile(c, "ndt", trial.tile))
        return next(one.state for one in known if one.version == trial.version)

    def settle(self, trial: VersionTrial, state: TrialState) -> None:
        wait_for(f"{trial.tile} is {state}", lambda: self.state(trial) == state)

    def stays_open(self, trial: VersionTrial, for_s: float = 2.5) -> None:
        """For more than two looks of the shards."""
        end_s = time.monotonic() + for_s
        while time.monotonic() < end_s:
            assert self.is_open(trial), self.state(trial)
            time.sleep(0.05)

    def fetched(self, car: str, tile: TileId, held: Tile | None = None) -> Tile:
        """What the tile server gives a vehicle."""
        holder = TilesInMemory("ndt", {} if held is None else {tile: held})
        exchange: Exchange[Tile] = Exchange(self.vehicles, holder, 10.0, ticket=ticket_of(car))
        (found,) = exchange.ask([tile], (), 1_000_000).fetched
        assert found.tile is not None
        return found.tile

    def released_version(self, tile: TileId) -> int:
        stored = released(self.store, "ndt", tile)
        assert stored is not None
        return stored.version


def visit(trial: VersionTrial, arm: Arm, **said: int | bool) -> TileHealth:
    """What a vehicle tells that drove through: all is well unless it says otherwise."""
    version = trial.version if arm == "new" else trial.base_version
    usual = {"scans": 20, "matched_permille": 900, "fit_permille": 790, "elsewhere_permille": 790, "inside": 15}
    return TileHealth(trial.tile, **{"version": version, **usual, "left": True, **said})  # type: ignore[arg-type]
