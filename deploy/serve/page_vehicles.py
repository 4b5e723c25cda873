"""Where the vehicles of a run are, and how they fare: from the ways that they write, and from what they say on the bus.

A vehicle says where it is once a kilometre, to save bytes; the way that it writes on its own disk has a line with place
and health every five metres, and its result says that its drive has ended. On the machine of a `gnd fleet` the page
reads all of them.
"""

import json
import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from gnd.deploy.run_folder import RunFolder
from gnd.gnd_map.bounded import json_value
from gnd.schemas.traffic import TrafficSample

MOST_POINTS: Final = 20_000
"""Of a vehicle's way so many points are kept."""
MOST_VEHICLES: Final = 2_000
_LINE_BYTES: Final = 4096
_NS_PER_MS: Final = 1_000_000
_LEAST_M: Final = 0.5
_LONGEST_HEALTH: Final = 16


@dataclass(frozen=True, slots=True)
class WayPoint:
    """A vehicle at a time: POSIX ms, radians, metres driven; its health, "" where the way does not tell it."""

    wall_ms: int
    lat_rad: float
    lon_rad: float
    odometer_m: float
    health: str = ""


class WayTail:
    """Reads on in a way that somebody writes.

    Args:
        path: the file; it may not be there yet.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._read, self._rest = path, 0, b""

    def more(self) -> Iterator[WayPoint]:
        """The points of whole lines that have come since; a line that is no milestone is left out."""
        try:
            with self._path.open("rb") as file:
                if file.seek(0, 2) < self._read:  # written anew
                    self._read, self._rest = 0, b""
                file.seek(self._read)
                data = file.read()
        except OSError:
            return
        self._read += len(data)
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > _LINE_BYTES:
            self._rest = b""
        for line in lines:
            point = _point(line)
            if point is not None:
                yield point


def _point(line: bytes) -> WayPoint | None:
    try:
        told = json_value(line.decode())
        point = WayPoint(
            int(told["wall_ns"]) // _NS_PER_MS,
            float(told["lat_rad"]),
            float(told["lon_rad"]),
            float(told["odometer_m"]),
            str(told.get("health", ""))[:_LONGEST_HEALTH],
        )
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError):
        return None
    is_place = abs(point.lat_rad) <= math.pi / 2 and abs(point.lon_rad) <= math.pi
    return point if is_place and math.isfinite(point.odometer_m) else None


@dataclass(slots=True)
class _Vehicle:
    points: list[tuple[int, float, float, float]]
    """POSIX ms, east, north, up in the map's frame."""
    odometer_m: float = 0.0
    heading_rad: float | None = None
    health: str = ""
    tiles: int = 0
    reports: int = 0
    doubts: int = 0
    has_ended: bool = False


class PageVehicles:
    """The vehicles of a run. May be asked from several threads.

    Args:
        run: its folder; None: what is said on the bus alone.
        place: east and north of a latitude and longitude, in the map's frame.
        ground_m: height there.
    """

    def __init__(
        self,
        run: RunFolder | None,
        place: Callable[[float, float], tuple[float, float]],
        ground_m: Callable[[float, float], float],
    ) -> None:
        self._run, self._place, self._ground_m = run, place, ground_m
        self._tails: dict[str, WayTail] = {}
        self._known: dict[str, _Vehicle] = {}
        self._said: dict[str, TrafficSample] = {}
        self._lock = threading.Lock()

    def on_sample(self, sample: TrafficSample, wall_ms: int) -> None:
        """Take what a vehicle says of itself."""
        with self._lock:
            is_known = sample.vehicle in self._known or sample.vehicle in self._said
            if not is_known and len(self._known) + len(self._said) >= MOST_VEHICLES:
                return
            self._said[sample.vehicle] = sample
            if sample.has_position and sample.vehicle not in self._tails:
                at = WayPoint(wall_ms, sample.lat_rad, sample.lon_rad, sample.odometer_m)
                self._move(sample.vehicle, at)

    def look(self) -> list[dict[str, Any]]:
        """Read on in the ways; the vehicles that have moved or said something since the last look."""
        with self._lock:
            moved = set()
            for name, tail in self._ways():
                for point in tail.more():
                    self._move(name, point)
                    moved.add(name)
            moved |= {name for name in self._tails if self._has_just_ended(name)}
            while self._said:
                name, sample = self._said.popitem()
                moved |= {name} if self._heard(name, sample) else set()
            return [self._told(name) for name in sorted(moved)]

    def all(self) -> list[dict[str, Any]]:
        """Every vehicle as it was last."""
        with self._lock:
            return [self._told(name) for name in sorted(self._known)]

    def ways(self) -> dict[str, list[tuple[int, float, float, float]]]:
        """The way of each vehicle: POSIX ms, east, north, up in the map's frame."""
        with self._lock:
            return {name: list(one.points) for name, one in sorted(self._known.items())}

    def _ways(self) -> Iterator[tuple[str, WayTail]]:
        if self._run is not None and self._run.agents.is_dir():
            for folder in sorted(self._run.agents.iterdir())[:MOST_VEHICLES]:
                self._tails.setdefault(folder.name, WayTail(self._run.way(folder.name)))
        return iter(list(self._tails.items()))

    def _has_just_ended(self, name: str) -> bool:
        """Whether the end of a drive is news; an agent that drives again has not ended."""
        one = self._known.get(name)
        if self._run is None or one is None:
            return False
        was = one.has_ended
        one.has_ended = _is_newer(self._run.result(name), self._run.way(name))
        return one.has_ended != was

    def _heard(self, name: str, sample: TrafficSample) -> bool:
        one = self._known.setdefault(name, _Vehicle([]))
        now = sample.health, sample.tiles, sample.reports, sample.tiles_doubtful
        if now == (one.health, one.tiles, one.reports, one.doubts):
            return False
        one.health, one.tiles, one.reports, one.doubts = now
        one.odometer_m = max(one.odometer_m, sample.odometer_m)
        return True

    def _move(self, name: str, point: WayPoint) -> None:
        one = self._known.setdefault(name, _Vehicle([]))
        east_m, north_m = self._place(point.lat_rad, point.lon_rad)
        if point.odometer_m < one.odometer_m - 1.0 and name in self._tails:  # a restarted agent drives anew
            one.points.clear()
        one.odometer_m, one.health = point.odometer_m, point.health or one.health
        if one.points:
            _, east, north, _ = one.points[-1]
            if math.hypot(east_m - east, north_m - north) >= _LEAST_M:
                one.heading_rad = math.atan2(north_m - north, east_m - east)
        up_m = self._ground_m(east_m, north_m) or (one.points[-1][3] if one.points else 0.0)
        one.points.append((point.wall_ms, round(east_m, 2), round(north_m, 2), round(up_m, 2)))
        del one.points[:-MOST_POINTS]

    def _told(self, name: str) -> dict[str, Any]:
        one = self._known[name]
        return {
            "name": name,
            "at": one.points[-1] if one.points else None,
            "heading_rad": one.heading_rad,
            "odometer_m": round(one.odometer_m, 1),
            "health": one.health,
            "ended": one.has_ended,
            "tiles": one.tiles,
            "reports": one.reports,
            "doubts": one.doubts,
        }


def _is_newer(one: Path, other: Path) -> bool:
    try:
        return one.stat().st_mtime_ns >= other.stat().st_mtime_ns
    except OSError:
        return False


def run_is_going(folder: RunFolder) -> bool:
    """Whether the processes of a run are there: it has no summary yet, and the router that it names lives."""
    if folder.summary.exists():
        return False
    try:
        pids = json.loads(folder.pids.read_text(encoding="utf-8"))
        return Path(f"/proc/{int(pids['router'])}").exists()
    except (OSError, ValueError, TypeError, KeyError):
        return False
