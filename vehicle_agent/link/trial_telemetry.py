"""What the vehicle tells of tiles of which a version is on trial: how its scans lie on them, and how its pose fares.

Where nothing is on trial, nothing is looked at and nothing is sent. The main thread looks, the thread of the telemetry
sends; a message holds the totals of a visit, so the next one makes up for a lost one.
"""

import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import groupby
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.health import HealthReport, TileHealth
from gnd.schemas.limits import MAX_TILES_OF_HEALTH
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.estimates import RefinedScan
from gnd.vehicle_agent.localise.parameters import RegistrationParameters
from gnd.vehicle_agent.localise.tile_fit import TileFit, TileFits
from gnd.vehicle_agent.place import Place

LOOK_M: Final = 2.0
"""A scan is looked at after so much way."""
LONG_S: Final = 60.0
"""A visit that takes longer is told of before it ends."""
TROUBLE_S: Final = 10.0
"""New trouble is told no oftener than this, by the time of the drive."""


@dataclass(slots=True)
class _Visit:
    """A tile on trial while it is held: totals, and what was told of them."""

    tile: TileId
    version: int
    scans: int = 0
    matched: float = 0.0
    fit: float = 0.0
    elsewhere: float = 0.0
    inside: int = 0
    gated: int = 0
    not_good: int = 0
    left: bool = False
    told: TileHealth | None = None
    told_ns: int = 0

    def add(self, fit: TileFit, elsewhere: TileFit) -> None:
        self.scans += 1
        self.matched += fit.matched
        self.fit += fit.fit
        self.elsewhere += elsewhere.fit

    def enter(self, *, gated: bool, good: bool) -> None:
        self.inside += 1
        self.gated += gated
        self.not_good += not good

    def totals(self) -> TileHealth:
        shares = (self.matched, self.fit, self.elsewhere)
        matched, fit, elsewhere = (round(1000 * share / max(self.scans, 1)) for share in shares)
        counts = (self.inside, self.gated, self.not_good)
        return TileHealth(self.tile, self.version, self.scans, matched, fit, elsewhere, *counts, left=self.left)

    def has_news(self, t_ns: int) -> bool:
        """Whether there is something to tell now: it was taken or left, trouble has come, or it goes on for long."""
        if self.told is None or self.left != self.told.left:
            return True
        passed_s = (t_ns - self.told_ns) * 1e-9
        more = self.not_good > self.told.not_good or self.gated > self.told.gated
        is_long = not self.told.is_told and self.scans > 0 and passed_s >= LONG_S
        return is_long or (more and passed_s >= TROUBLE_S)

    def tell(self, t_ns: int) -> TileHealth:
        """The totals, from now on told."""
        self.told, self.told_ns = self.totals(), t_ns
        return self.told


class TrialTelemetry:
    """Looks at the tiles on trial around the vehicle.

    Args:
        local_map: the tiles that are held.
        watched: the tiles of which a version is on trial.
        layer: of the map.
        parameters: of registration.
    """

    def __init__(
        self,
        local_map: LocalMap,
        watched: Callable[[], frozenset[TileId]],
        layer: str,
        parameters: RegistrationParameters,
    ) -> None:
        self._map, self._watched, self._layer = local_map, watched, layer
        self._fits = TileFits(local_map, parameters)
        self._lock = threading.Lock()
        self._visits: dict[TileId, _Visit] = {}
        self._over: list[_Visit] = []
        self._seen_m: F64 | None = None
        self._lost_m = -LOOK_M
        self._t_ns = self._told_ns = 0

    def see(self, scan: RefinedScan) -> None:
        """Look at a scan whose pose has become final."""
        if not self._follow(scan.t_ns):
            return
        here = scan.estimate.T_map_vehicle[:3, 3]
        if self._seen_m is not None and float(np.linalg.norm(here - self._seen_m)) < LOOK_M:
            return
        self._seen_m = here.copy()
        fits, elsewhere = self._fits.of(scan.points_map_m, here, self._visits)
        with self._lock:
            if elsewhere is not None:  # else nothing says whose fault it is
                for tile, fit in fits.items():
                    self._visits[tile].add(fit, elsewhere)
            visit = self._visits.get(self._tile_at(here))
            if visit is not None:
                estimate = scan.estimate
                gated = estimate.matching_ratio == 0.0 or estimate.disagrees
                visit.enter(gated=gated, good=estimate.health == "good")

    def note(self, place: Place) -> None:
        """After each scan, whether or not it found a pose: one that is lost in a tile on trial counts there."""
        if not self._follow(place.t_ns) or place.health != "lost" or place.odometer_m - self._lost_m < LOOK_M:
            return
        self._lost_m = place.odometer_m
        with self._lock:
            visit = self._visits.get(self._tile_at(place.position_map_m))
            if visit is not None:
                visit.enter(gated=True, good=False)

    def due(self, *, all_of_it: bool = False) -> list[HealthReport]:
        """The messages that are to go out now; `all_of_it`: the drive has ended."""
        with self._lock:
            over, self._over = self._over, []
            if all_of_it:
                for visit in self._visits.values():
                    visit.left = True
            return [*self._tell(over), *self._tell(self._visits.values())]

    def _tell(self, visits: Iterable[_Visit]) -> Iterator[HealthReport]:
        """The messages about those of some visits of which there is news, a tile once."""
        news = {visit.tile: visit for visit in visits if visit.has_news(self._t_ns)}
        self._told_ns = max(self._told_ns + 1, self._t_ns)
        for district, group in groupby(sorted(news), lambda tile: tile.district):
            told = tuple(news[tile].tell(self._told_ns) for tile in list(group)[:MAX_TILES_OF_HEALTH])
            yield HealthReport(self._layer, district, self._told_ns, told)

    def _follow(self, t_ns: int) -> bool:
        """Begin and end visits as tiles come and go; whether any is under way."""
        watched = self._watched()
        if not watched and not self._visits:
            return False
        tiles = {tile: self._map.tile(tile) for tile in watched}
        held = {tile: found.version for tile, found in tiles.items() if found is not None and found.version}
        with self._lock:
            self._t_ns = max(self._t_ns, t_ns)
            for tile, visit in list(self._visits.items()):
                if held.get(tile) != visit.version:
                    visit.left = True
                    self._over.append(self._visits.pop(tile))
            for tile, version in held.items():
                if tile not in self._visits:
                    self._visits[tile] = _Visit(tile, version)
            return bool(self._visits)

    def _tile_at(self, p_map_m: F64) -> TileId:
        lat, lon, _ = self._map.grid_frame.frame.geodetic_from_enu(np.asarray(p_map_m)[None])
        return TileId.from_geodetic(float(lat[0]), float(lon[0]))
