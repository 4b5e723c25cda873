"""Where trips begin and end: nothing is told of a circle around each, and its centre is not the place itself.

The end of a trip is not known before it comes. So what a vehicle tells of a place waits until the vehicle is farther
away than a circle reaches, and of what still waits at the end only that goes on which lies outside the circle of the
end. A circle is laid down once a place, drawn at random, and remembered: whoever lays the gaps of a hundred trips over
each other finds the same circle a hundred times, and not the door in its middle.
"""

import json
import math
import secrets
import threading
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.bounded import json_value
from gnd.gnd_map.features import is_feature_layer
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport
from gnd.schemas.drive import GnssFix
from gnd.schemas.features import FeatureReport
from gnd.schemas.health import HealthReport
from gnd.schemas.keys import parse_change_key
from gnd.schemas.survey import SurveyReport, is_survey
from gnd.vehicle_agent.config import PRIVATE_OFF, PRIVATE_SEEN_M
from gnd.vehicle_agent.errors import VehicleError
from gnd.vehicle_agent.place import Place
from gnd.vehicle_agent.report.sink import OutgoingReport, ReportSink
from gnd.vehicle_agent.surroundings import TileRectangles

DRAWN_OFF: Final = 0.5
"""A new centre lies at random within this share of the radius from the place; others near by share it."""
MAX_CIRCLES: Final = 200
_STEP_M: Final = 5.0


@dataclass(frozen=True, slots=True)
class Circle:
    """A private place; the place lies somewhere within `PRIVATE_OFF` times the radius of the centre."""

    lat_rad: float
    lon_rad: float
    radius_m: float

    def __post_init__(self) -> None:
        if not (abs(self.lat_rad) <= math.pi / 2 and abs(self.lon_rad) <= math.pi and 0 < self.radius_m < 1e5):
            raise VehicleError(f"a circle of {self.radius_m} m at ({self.lat_rad}, {self.lon_rad}) rad")

    def centre_m(self, frame: LocalFrame) -> F64:
        """(3,) in a frame."""
        return frame.enu_from_geodetic(self.lat_rad, self.lon_rad, 0.0).reshape(3)

    def hides(self, frame: LocalFrame, tiles: TileRectangles) -> bool:
        """Whether nothing may be told of one of these tiles."""
        return bool((tiles.distances_m(self.centre_m(frame)) <= self.radius_m + PRIVATE_SEEN_M).any())

    def is_of(self, frame: LocalFrame, p_map_m: F64) -> bool:
        """Whether it can stand for a place."""
        return math.dist(self.centre_m(frame)[:2], p_map_m[:2]) <= PRIVATE_OFF * self.radius_m


class Circles:
    """The circles of a vehicle, kept in a file that never leaves it.

    Args:
        path: of the file; it is made with the first circle.
        radius_m: of new ones.

    Raises:
        VehicleError: the file cannot be read.
    """

    def __init__(self, path: Path, radius_m: float) -> None:
        self._path, self.radius_m = path, radius_m
        try:
            told = json_value(path.read_text(encoding="utf-8")) if path.exists() else []
            self._known = [Circle(**one) for one in told]
        except (OSError, ValueError, TypeError, VehicleError) as error:
            raise VehicleError(
                f"cannot read the private places in {path}: {error}; without it they would be laid anew, and whoever"
                " compares old and new gaps would find the places: restore the file, or remove it if you accept that"
            ) from error

    def at(self, frame: LocalFrame, p_map_m: F64) -> Circle:
        """The circle of a place (3,): the one that it had before, or a new one."""
        for one in self._known:
            if one.is_of(frame, p_map_m):
                return one
        draw = secrets.SystemRandom()
        angle_rad, away_m = draw.uniform(0, 2 * math.pi), DRAWN_OFF * self.radius_m * math.sqrt(draw.random())
        centre = p_map_m + away_m * np.array([math.cos(angle_rad), math.sin(angle_rad), 0.0])
        lat, lon, _ = frame.geodetic_from_enu(centre[None])
        new = Circle(float(lat[0]), float(lon[0]), self.radius_m)
        self._known = [*self._known, new][-MAX_CIRCLES:]
        self._write()
        return new

    def _write(self) -> None:
        partial = self._path.with_name(self._path.name + ".partial")
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            partial.write_text(json.dumps([asdict(one) for one in self._known]), encoding="utf-8")
            partial.chmod(0o600)
            partial.replace(self._path)
        except OSError as error:
            raise VehicleError(f"cannot keep the private places in {self._path}: {error.strerror}") from error


@dataclass(frozen=True, slots=True)
class _KeptBack:
    """What is to leave the vehicle once it is far enough: a report or a word on trials.

    Attributes:
        where: the tiles that it speaks of; of a part of a survey points, where satellites saw the vehicle.
        what: it.
        survey_id: of a part of a survey, which waits until the trip has ended; else "".
    """

    where: TileRectangles
    what: OutgoingReport | HealthReport
    survey_id: str = ""


class PrivatePlaces:
    """Stands between what a vehicle makes and what leaves it. Safe in several threads.

    Args:
        circles: of the vehicle.
        hold_m: what lies nearer than this could lie in the circle of the trip's end.
        fix: where the trip begins.
        sink: where reports go on.

    Attributes:
        counts: reports and words on trials that were `passed` on and `kept_back` for good.
    """

    def __init__(self, circles: Circles, hold_m: float, fix: GnssFix, sink: ReportSink) -> None:
        self._circles, self._hold_m, self._sink = circles, hold_m, sink
        self._frame = LocalFrame.of_tile(TileId.from_geodetic(fix.lat_rad, fix.lon_rad))
        self._here_m = self._frame.enu_from_geodetic(fix.lat_rad, fix.lon_rad, fix.height_m).reshape(3)
        self._hiding = [circles.at(self._frame, self._here_m)]
        self._lock = threading.RLock()
        self._has_ended = False
        self._waiting: list[_KeptBack] = []
        self._said: list[HealthReport] = []
        self._hidden: set[str] = set()  # surveys
        self.counts: Counter[str] = Counter()

    def put(self, report_id: str, key: str, body: bytes, packed: bytes = b"", bases: Iterable[Tile] = ()) -> bool:
        """Take a report; it goes on when the vehicle is far enough. False when its id is known already."""
        if self.body_of(report_id) is not None:
            return False
        report = self._read(OutgoingReport(report_id, key, body, packed, tuple(bases)))
        with self._lock:
            self._waiting.append(report)
            self._look()
        return True

    def body_of(self, report_id: str) -> bytes | None:
        """The body that waits or has gone on under an id, None without one."""
        with self._lock:
            for one in self._waiting:
                if isinstance(one.what, OutgoingReport) and one.what.report_id == report_id:
                    return one.what.body
        return self._sink.body_of(report_id)

    def hides(self, tile: TileId) -> bool:
        """Whether nothing will ever be told of a tile in this trip."""
        with self._lock:
            return self._hide(self._lie([tile]))

    def say(self, told: Collection[HealthReport]) -> list[HealthReport]:
        """Take words on trials; gives those that may be said now."""
        with self._lock:
            self._waiting += [_KeptBack(self._lie([tile.tile for tile in one.tiles]), one) for one in told]
            self._look()
            free, self._said = self._said, []
        return free

    def move(self, place: Place) -> None:
        """The vehicle is here."""
        lat, lon, height = place.frame.geodetic_from_enu(place.position_map_m[None])
        here_m = self._frame.enu_from_geodetic(lat, lon, height).reshape(3)
        with self._lock:
            if math.dist(here_m[:2], self._here_m[:2]) >= _STEP_M:
                self._here_m = here_m
                self._look()

    def end(self) -> None:
        """The trip ends where the vehicle is: what lies outside of its circles goes on, the rest never does."""
        with self._lock:
            if not self._has_ended:
                self._has_ended = True
                self._hiding.append(self._circles.at(self._frame, self._here_m))
                self._look()

    def _look(self) -> None:
        self._hidden |= {one.survey_id for one in self._waiting if one.survey_id and self._is_hidden(one)}
        waiting, self._waiting = self._waiting, []
        for one in waiting:
            if one.survey_id in self._hidden or self._is_hidden(one):
                self.counts["kept_back"] += 1
            elif self._has_ended or self._is_far(one):
                self.counts["passed"] += 1
                self._pass_on(one.what)
            else:
                self._waiting.append(one)

    def _pass_on(self, what: OutgoingReport | HealthReport) -> None:
        if isinstance(what, HealthReport):
            self._said.append(what)
        else:
            self._sink.put(what.report_id, what.key, what.body, what.packed, what.bases)

    def _is_hidden(self, one: _KeptBack) -> bool:
        if len(one.where.low_m) == 0:
            return self._has_ended  # nothing says where it was
        return self._hide(one.where)

    def _is_far(self, one: _KeptBack) -> bool:
        """Whether the trip cannot end near it; the parts of a survey belong together."""
        return not one.survey_id and bool((one.where.distances_m(self._here_m) > self._hold_m).all())

    def _hide(self, where: TileRectangles) -> bool:
        return any(circle.hides(self._frame, where) for circle in self._hiding)

    def _lie(self, tiles: Iterable[TileId]) -> TileRectangles:
        return TileRectangles.of(self._frame, tiles)

    def _read(self, report: OutgoingReport) -> _KeptBack:
        """What a report speaks of."""
        if is_survey(report.body):
            survey = SurveyReport.decode(report.body)
            geodetic = np.array([(fix.lat_rad, fix.lon_rad, fix.height_m) for fix in survey.fixes]).reshape(-1, 3)
            seen_m = self._frame.enu_from_geodetic(*geodetic.T)[:, :2]
            return _KeptBack(TileRectangles(seen_m, seen_m), report, survey.survey_id)
        layer, _ = parse_change_key(report.key)
        if is_feature_layer(layer):
            return _KeptBack(self._lie(one.tile for one in FeatureReport.decode(report.body).tiles), report)
        return _KeptBack(self._lie(one.tile for one in ChangeReport.decode(report.body).tiles), report)
