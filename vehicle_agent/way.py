"""Which map a vehicle drove on: every few metres a line with time, place and the version of the tile under the wheels.

Each line is on the disk at once, so what goes on can be watched from outside. A restarted agent writes its way anew,
below that of its earlier life.
"""

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from gnd.gnd_map.bounded import json_value
from gnd.gnd_map.config import from_mapping
from gnd.gnd_map.errors import ConfigError
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.errors import VehicleError
from gnd.vehicle_agent.place import Place

WAY_FILE: Final = "way.jsonl"
EVERY_M: Final = 5.0


@dataclass(frozen=True, slots=True)
class Milestone:
    """A vehicle at one place of its way.

    Attributes:
        t_ns: time of the drive.
        wall_ns: time of the machine, UTC.
        odometer_m: way so far.
        lat_rad, lon_rad: where.
        tile: Morton id of the tile under the wheels.
        version: of that tile, as the vehicle holds it; 0: there is none in the store, None: it is not held (yet).
        health: of the pose; "": a way that was written before ways told it.
    """

    t_ns: int
    wall_ns: int
    odometer_m: float
    lat_rad: float
    lon_rad: float
    tile: int
    version: int | None
    health: str = ""


class Way:
    """Writes the milestones of a drive.

    Args:
        path: file to append to.
        held: gives the tile of an id as the vehicle holds it, None where it does not.

    Raises:
        VehicleError: the file cannot be written.
    """

    def __init__(self, path: Path, held: Callable[[TileId], Tile | None]) -> None:
        self._held, self._last_m = held, -EVERY_M
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("a", encoding="utf-8", buffering=1)
        except OSError as error:
            raise VehicleError(f"cannot write the way to {path}: {error.strerror}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._file.close()

    def note(self, place: Place) -> None:
        """Write a line if the vehicle has come far enough since the last one."""
        if place.odometer_m - self._last_m < EVERY_M:
            return
        self._last_m = place.odometer_m
        lat_rad, lon_rad = place.geodetic
        tile_id = TileId.from_geodetic(lat_rad, lon_rad)
        tile = self._held(tile_id)
        version = None if tile is None else tile.version
        at = place.t_ns, time.time_ns(), place.odometer_m, lat_rad, lon_rad
        one = Milestone(*at, tile_id.morton, version, place.health)
        print(json.dumps(asdict(one), separators=(",", ":")), file=self._file)


def read_way(path: Path) -> Iterator[Milestone]:
    """Give the milestones of a file, of a restarted agent those of its last life; nothing where there is none.

    Raises:
        VehicleError: a line is none of a way's.
    """
    found: list[Milestone] = []
    try:
        lines = path.read_text(encoding="utf-8").split("\n")[:-1] if path.exists() else []
    except (OSError, UnicodeDecodeError) as error:
        raise VehicleError(f"cannot read the way {path}: {error}") from error
    for line in lines:
        try:
            one = from_mapping(Milestone, json_value(line))
        except (ValueError, ConfigError) as error:
            raise VehicleError(f"{path} holds a line that is no milestone: {line[:80]!r}") from error
        if found and one.odometer_m < found[-1].odometer_m:
            found.clear()
        found.append(one)
    return iter(found)
