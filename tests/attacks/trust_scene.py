"""A router, a store and a shard as processes, streets of four tiles, and what vehicles say of them over the bus."""

import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.verify import Verifier
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile, content_sha
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "cloud_merger"))
from merger_processes import Cloud, wait_for
from merger_world import BALL, GROUND, WALL, State, change_of, gaussians_of, report_of, seen_by

SHARD = "guarded"
FIRST = 497353963152
STREETS = 24
NS = 1_700_000_000_000_000_000
WIDE = 24
Changes = Mapping[TileId, Mapping[int, State | None]]
NOTHING: Changes = {}


def _voxels(tile: TileId, row: int, floors: tuple[int, ...]) -> list[int]:
    grid = VoxelGrid.of(tile)
    return sorted(int(grid.voxel_id(3 + n, row, floor)) for n in range(WIDE) for floor in floors)


def wall(tile: TileId) -> list[int]:
    """Voxels of the wall that the map holds."""
    return _voxels(tile, 10, (40, 41))


def free(tile: TileId) -> list[int]:
    """Voxels in which the map holds nothing, two floors high like a wall."""
    return _voxels(tile, 13, (40, 41))


def block(tile: TileId) -> Gaussians:
    """A tile that is full of masonry: of so much one vehicle is believed 2 %."""
    grid = VoxelGrid.of(tile)
    ids = [int(grid.voxel_id(x, y, z)) for x in range(2, 27) for y in range(2, 27) for z in range(39, 63)]
    return gaussians_of(dict.fromkeys(ids, WALL))


def corner(tile: TileId) -> list[int]:
    """Voxels of the block on its top, in one piece: nearly 2 % of it."""
    grid = VoxelGrid.of(tile)
    return sorted(int(grid.voxel_id(x, y, 62)) for x in range(2, 27) for y in range(2, 14))


def base(tile: TileId) -> Gaussians:
    """The tile as the map has it."""
    ground = [voxel for row in (7, 8, 9, 10) for voxel in _voxels(tile, row, (39,))]
    return gaussians_of(dict.fromkeys(wall(tile), WALL) | dict.fromkeys(ground, GROUND))


@dataclass
class Street:
    """Four tiles of their own, on which one attack is tried."""

    cloud: Cloud
    number: int
    tiles: list[TileId] = field(default_factory=list)
    sent: int = 0

    def __post_init__(self) -> None:
        assert self.number < STREETS, "the map holds no such street"
        self.tiles = [TileId(FIRST + 4 * self.number + k) for k in range(4)]

    @property
    def untouched(self) -> list[bytes]:
        return [content_sha(tile, base(tile)) for tile in self.tiles]

    @property
    def shas(self) -> list[bytes]:
        return [head.sha for tile in self.tiles if (head := self.cloud.store.get("ndt", tile)) is not None]

    @property
    def gone(self) -> Changes:
        return {tile: dict.fromkeys(wall(tile), None) for tile in self.tiles}

    @property
    def built(self) -> Changes:
        return {tile: dict.fromkeys(free(tile), BALL) for tile in self.tiles}

    def name(self, vehicle: str) -> str:
        """Vehicles of one street are not those of another."""
        return f"{vehicle}-{self.number}"

    def report(
        self,
        vehicle: str,
        changes: Changes,
        at_s: int | None = None,
        *,
        tiles: Sequence[TileId] = (),
        unsure: Changes = NOTHING,
        cells: int = 0,
        as_measured: bool = False,
    ) -> ChangeReport:
        """What a vehicle says of all tiles, or of some; all else is as in the map, but for what it is unsure of, with
        so many cells. Vehicles drive a minute after each other. `as_measured`: without noise of its own.
        """
        self.sent += 1
        at_ns = NS + (60 * self.sent if at_s is None else at_s) * 10**9
        told = []
        for tile in tiles or self.tiles:
            met = gaussians_of(unsure.get(tile, {}), cells, cells)
            seen = sorted({*base(tile).voxel_id.tolist(), *free(tile)} - {*met.voxel_id.tolist()})
            changed = changes.get(tile, {}) if as_measured else seen_by(vehicle, changes.get(tile, {}))
            said = change_of(base(tile), seen, changed, tile=tile)
            told.append(replace(said, unsure=met))
        made = report_of(1000 * self.number + self.sent, *told, vehicle=self.name(vehicle))
        return replace(made, first_ns=at_ns - 20 * 10**9, last_ns=at_ns)

    def say(self, vehicle: str, changes: Changes, at_s: int | None = None, **said: Any) -> ChangeReport:
        """Send it over the bus; it is acknowledged."""
        report = self.report(vehicle, changes, at_s, **said)
        ack = self.cloud.send(report)
        assert ack.status in ("stored", "duplicate"), ack
        return report

    def settle(self) -> None:
        """Until all is merged and announced."""
        wait_for("all is merged", self.cloud.is_settled, 200.0)  # a new machine compiles the kernels first
        time.sleep(0.1)
        wait_for("all is merged", self.cloud.is_settled, 200.0)

    def judge(self) -> None:
        """One more vehicle, which misses a voxel of the ground in each tile: reports that only confirm the newest
        version are not merged, and judge nobody, until somebody says something.
        """
        self.say("last", {tile: {_voxels(tile, 7, (39,))[0]: None} for tile in self.tiles})
        self.settle()

    def new(self) -> list[int]:
        """Of each tile how many voxels it holds where the map held nothing."""
        heads = [self.cloud.store.get("ndt", tile) for tile in self.tiles]
        held = [set() if head is None else {*head.decode_gaussians().gaussians.voxel_id.tolist()} for head in heads]
        return [len(ids & {*free(tile)}) for ids, tile in zip(held, self.tiles, strict=True)]

    def statuses(self) -> set[str]:
        """What comes of computing all versions of all tiles anew."""
        verifier = Verifier(self.cloud.store, ShardConfig("verifier", self.cloud.path))
        history = [(tile, one.version) for tile in self.tiles for one in self.cloud.store.history("ndt", tile)]
        return {verifier.version("ndt", *one).status for one in history}

    def not_believed_alone(self) -> dict[str, str]:
        """Of this street's vehicles those whose lone word waits everywhere, and why."""
        end = f"-{self.number}"
        words = [one for one in self.cloud.store.lone_words() if one.vehicle.endswith(end)]
        return {one.vehicle.removesuffix(end): one.why for one in words}

    def quarantined(self) -> set[str]:
        """Those of this street whose reports do not count."""
        end = f"-{self.number}"
        return {one.removesuffix(end) for one in self.cloud.store.quarantined_vehicles() if one.endswith(end)}

    def reasons(self, vehicle: str) -> set[str]:
        """Why claims of a vehicle wait."""
        return {one.reason for one in self.cloud.store.waiting_changes() if one.vehicle == self.name(vehicle)}


@contextmanager
def guarded_cloud(folder: Path, port: int, settings: str = "") -> Iterator[Cloud]:
    """A cloud with all streets; `settings`: more of its shard, as TOML."""
    cloud = Cloud(folder, port)
    cloud.config_path.write_text(cloud.config_path.read_text() + settings)
    cloud.open()
    try:
        cloud.store.put_tiles([Tile(one, 1, base(one)) for n in range(STREETS) for one in Street(cloud, n).tiles])
        cloud.start(SHARD)
        yield cloud
    finally:
        cloud.close()
