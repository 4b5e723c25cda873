"""The local map follows the vehicle: tiles ahead are asked for, arrivals are held, tiles far behind are let go."""

import math
import threading
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.errors import TileError
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import District, TileId, covering_corridor
from gnd.schemas.limits import MAX_TILES_OF_DISTRICT
from gnd.tile_client.exchange import Fetched
from gnd.vehicle_agent.config import LEAD_S, DownloadParameters
from gnd.vehicle_agent.link.download import TileFetcher
from gnd.vehicle_agent.link.plan import Need, in_time, needs, tile_boxes_m
from gnd.vehicle_agent.local_map import LocalMap, Touched
from gnd.vehicle_agent.place import Place

STEP_M = 5.0  # the wanted tiles are looked at again after this much way
AHEAD_S = 15.0  # tiles are asked for so long in advance, and at least `ahead_m`; longer than `LEAD_S`
HELD_AHEAD_M: Final = 400.0
"""Where the cache holds this share of what is farther ahead, whether that still holds is asked with the next question:
one of its own costs 400 B with its answer, another tile in it some 1."""
HELD_AROUND_M: Final = 1300.0
"""And so are those that the cache holds of the districts of the plan: they do not change with every degree of the
heading, as what lies straight ahead does."""
MOST_AROUND: Final = 256
NEARBY_M: Final = 500.0
"""What lies so far to either side of a place is of four districts at most, which are 1.2 km wide or, towards the poles,
less."""
KNOWN_SHARE: Final = 0.25
BEYOND_STEP_M: Final = 60.0
LINK_SHARE = 0.8  # part of the link's rate that the plan counts on
AHEAD_STEP_M = 20.0  # every small change of speed would be a reason to look again
FLOORS_BELOW, FLOORS_ABOVE = 8, 16  # of the vehicle, where the map alone does not show how high the world is


class Surroundings:
    """Keeps `local_map` in step with the place and the cache; the agent's main thread owns it.

    A tile about which there is evidence keeps its map until it is finished: evidence about one version is never
    counted for another. A newer version waits until then, and is what the next pass is compared with.
    """

    def __init__(
        self,
        local_map: LocalMap,
        fetcher: TileFetcher[Tile],
        touched: Touched,
        parameters: DownloadParameters,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._map, self._fetcher, self._touched = local_map, fetcher, touched
        self._parameters = parameters
        self._rate_byte_s = LINK_SHARE * fetcher.link.rate_byte_s("down")
        self.wanted: tuple[TileId, ...] = ()
        self._around: tuple[TileId, ...] = ()
        self._looked_at: F64 | None = None
        self._here: F64 | None = None
        self._asked: set[TileId] = set()  # with the last question, and not let go since
        self._besides: tuple[TileId, ...] = ()  # named with the next one, whenever that is
        self._besides_set: frozenset[TileId] = frozenset()  # the same
        self._named: frozenset[District] = frozenset()  # of these districts
        self._passed: set[TileId] = set()  # let go: asked for again when they are wanted, not before
        self._beyond: tuple[TileId, ...] = ()  # farther ahead than the plan
        self._looked_beyond: F64 | None = None
        self._farthest: F64 | None = None  # of the way ahead
        self._plan: list[Need] = []
        self._plan_is_new = False
        self._near: tuple[TileId, ...] = ()
        self._arrived: dict[TileId, Tile | None] = {}
        self._newer: dict[TileId, Tile] = {}  # of tiles about which there is evidence
        self.given_up: set[TileId] = set()

    def look_ahead(self, place: Place) -> tuple[TileId, ...]:
        """Plan anew after a few metres of way; gives the tiles around and ahead, those of `HELD_AHEAD_M` included: the
        same object until it plans anew.
        """
        if self._has_moved(place):
            self._look(place)
            self._around = (*self.wanted, *self._beyond)
        return self._around

    def follow(self, place: Place, stop: threading.Event, *, wait: bool) -> None:
        """Ask for what lies around and ahead and hold what is near; `wait` for the answers about that."""
        self.look_ahead(place)
        if self._plan_is_new:
            self._ask(patiently=wait)
        if wait:
            missing = set(self._near) - self.given_up
            self.given_up |= self._fetcher.wait_for(missing, self._parameters.wait_s, stop)
        for fetched in self._fetcher.take():
            self._arrive(fetched)
        for tile_id in self._near:
            if tile_id in self._arrived:
                self._hold(tile_id, self._arrived.pop(tile_id))

    def replace(self, tile: Tile) -> bool:
        """Use a newer version of a tile that waits or is held, unless evidence is gathered against the old one."""
        if tile.tile_id in self._arrived:
            self._arrived[tile.tile_id] = tile
            return True
        held = self._map.tile(tile.tile_id)
        if held is None or held.sha == tile.sha:
            self._newer.pop(tile.tile_id, None)
            return False
        if self._touched(tile.tile_id):
            self.counts["later"] += tile.tile_id not in self._newer
            self._newer[tile.tile_id] = tile
            return False
        self._newer.pop(tile.tile_id, None)
        self._map.set_tile(tile)
        return True

    def _has_moved(self, place: Place) -> bool:
        ahead = place.ahead_map_m(self._ahead_m(place))
        before = self._looked_at
        if before is not None and before.shape == ahead.shape and np.abs(ahead - before).max() <= STEP_M:
            return False
        self._looked_at = ahead
        return True

    def _ahead_m(self, place: Place) -> float:
        by_speed_m = AHEAD_S * abs(place.speed_mps)
        return max(self._parameters.ahead_m, AHEAD_STEP_M * math.ceil(by_speed_m / AHEAD_STEP_M))

    def _look(self, place: Place) -> None:
        p, here, frame = self._parameters, place.position_map_m, self._map.grid_frame.frame
        self._here = here
        floor = int(np.floor(place.height_m / FLOORS_BELOW)) * FLOORS_BELOW
        self._map.cover_floors(floor - FLOORS_BELOW, floor + FLOORS_ABOVE)
        self.wanted = tiles_along(frame, place.ahead_map_m(self._ahead_m(place)), p.near_m)
        self._look_beyond(place)
        self._plan = needs(frame, self.wanted, place.course, p.near_m)
        self._plan_is_new = True
        self._near = tuple(need.tile_id for need in self._plan if need.distance_m <= p.near_m)
        self._let_go(here)
        for tile in list(self._newer.values()):
            self.replace(tile)

    def _look_beyond(self, place: Place) -> None:
        """Which tiles lie farther ahead than the plan; found anew after some way, or where the course has turned."""
        ahead = place.ahead_map_m(HELD_AHEAD_M)
        self._farthest = ahead[-1]
        before = self._looked_beyond
        if before is None or before.shape != ahead.shape or np.abs(ahead - before).max() > BEYOND_STEP_M:
            self._looked_beyond = ahead
            tiles = tiles_along(self._map.grid_frame.frame, ahead, self._parameters.near_m)
            self._beyond = tuple(sorted(set(tiles).difference(self.wanted)))

    def _ask(self, *, patiently: bool) -> None:
        """Ask for the plan's tiles, all together, as soon as one of them is urgent, and whether those beyond it still
        hold that the cache has; else only for those asked for before. A drive that waits for its tiles gets all of
        them, another one what the link can bring in time.
        """
        self._plan_is_new = False
        plan = self._plan if patiently else self._in_time()
        lead_s = LEAD_S + self._download_s(plan)
        if any(need.from_s <= lead_s and not self._fetcher.is_known(need.tile_id) for need in plan):
            self._asked = {need.tile_id for need in plan} | self._known_beyond() | self._still_around()
            self._named = frozenset()
        self._name_besides()
        first = [need.tile_id for need in plan if need.tile_id in self._asked]
        self._fetcher.want([*first, *sorted(self._asked.difference(first))], self._besides)

    def _known_beyond(self) -> set[TileId]:
        """The tiles beyond the plan, where the cache holds many of them; then the others are most likely on no map,
        which costs little to hear, and else they are needed soon.
        """
        beyond = set(self._beyond).difference(self.wanted)
        held = sum(map(self._fetcher.is_held, beyond))
        return beyond | self._held_around() if held >= KNOWN_SHARE * len(beyond) else set()

    def _name_besides(self) -> None:
        """Which tiles the next question names besides, whenever it is asked: found anew where the districts change."""
        districts = frozenset({tile.district for tile in self.wanted} | self._nearby())
        if districts != self._named:
            self._named, self._besides = districts, self._of_known_districts(districts)
            self._besides_set = frozenset(self._besides)

    def _of_known_districts(self, districts: Collection[District]) -> tuple[TileId, ...]:
        """All tiles of the plan's districts and of those nearby, where the cache holds much of the plan: most are on no
        map, and to hear so of a whole district costs a few bytes more than of the tiles ahead, which change with the
        heading; to ask about the next district when it is reached costs a question.
        """
        if sum(map(self._fetcher.is_held, self.wanted)) < KNOWN_SHARE * len(self.wanted):
            return ()
        every = (
            TileId(one.first_morton + index) for one in sorted(districts) for index in range(MAX_TILES_OF_DISTRICT)
        )
        known = self._asked.union(self._passed, self._fetcher.held_of(districts))
        return tuple(tile for tile in every if tile not in known)

    def _nearby(self) -> set[District]:
        """The four districts that are nearest to what lies ahead, or fewer: one question can be about so many."""
        if self._farthest is None:
            return set()
        corners = self._farthest + NEARBY_M * np.array([[x, y, 0.0] for x in (-1.0, 1.0) for y in (-1.0, 1.0)])
        lat, lon, _ = self._map.grid_frame.frame.geodetic_from_enu(corners)
        return {TileId.from_geodetic(*corner).district for corner in zip(lat.tolist(), lon.tolist(), strict=True)}

    def _still_around(self) -> set[TileId]:
        """Those of the tiles asked for before that are not far away: who forgets them asks again."""
        asked = sorted(self._asked)
        if not asked or self._here is None:
            return set()
        away_m = TileRectangles.of(self._map.grid_frame.frame, asked).distances_m(self._here)
        return {asked[n] for n in np.flatnonzero(away_m <= HELD_AROUND_M)}

    def _held_around(self) -> set[TileId]:
        """The nearest tiles that the cache holds of the plan's districts."""
        districts = {tile.district for tile in self.wanted}
        held = [tile for tile in self._fetcher.held_of(districts) if tile not in self._passed]
        if not held or self._here is None:
            return set()
        away_m = TileRectangles.of(self._map.grid_frame.frame, held).distances_m(self._here)
        nearest = np.argsort(away_m, kind="stable")[:MOST_AROUND]
        return {held[n] for n in nearest if away_m[n] <= HELD_AROUND_M}

    def _in_time(self) -> list[Need]:
        if math.isinf(self._rate_byte_s):
            return self._plan
        return in_time(self._plan, self._fetcher.size_bytes, self._rate_byte_s, self._fetcher.link.delay_s)

    def _download_s(self, plan: Iterable[Need]) -> float:
        """How long the link is busy with what is not known of a plan."""
        if math.isinf(self._rate_byte_s):
            return 0.0
        return sum(self._fetcher.size_bytes(need.tile_id) for need in plan) / self._rate_byte_s

    def _let_go(self, here: F64) -> None:
        """Drop tiles far behind that nothing is counted about, and answers about tiles that are no longer wanted."""
        frame, limit_m = self._map.grid_frame.frame, self._parameters.forget_m
        gone = sorted(set(self._arrived).difference(self._asked, self.wanted, self._besides_set))
        for tile_id in gone:
            del self._arrived[tile_id]
        for tile_id in left_behind(frame, self._map.tiles, here, limit_m):
            if not self._touched(tile_id):
                self._map.remove_tile(tile_id)
                self._newer.pop(tile_id, None)
                gone.append(tile_id)
        for tile_id in gone:
            self._fetcher.forget(tile_id)
        self._asked.difference_update(gone)
        districts = {tile.district for tile in self.wanted}
        self._passed = {tile for tile in self._passed.union(gone) if tile.district in districts}

    def _arrive(self, fetched: Fetched[Tile]) -> None:
        """Take an answer: a tile (or the knowledge that there is none) waits until it is near."""
        if self._map.tile(fetched.tile_id) is None:
            self._arrived[fetched.tile_id] = fetched.tile
        elif fetched.tile is not None:
            self.replace(fetched.tile)

    def _hold(self, tile_id: TileId, tile: Tile | None) -> None:
        try:
            if tile is None:
                self._map.set_absent(tile_id)
            else:
                self._map.set_tile(tile)
        except TileError:  # a tile of another latitude zone has voxels that this grid frame cannot hold
            self.counts["other-zone"] += 1


def tiles_along(frame: LocalFrame, points_map_m: F64, half_width_m: float) -> tuple[TileId, ...]:
    """The tiles within `half_width_m` of the line through points (N, 3) of the map frame."""
    lat, lon, _ = frame.geodetic_from_enu(points_map_m)
    return covering_corridor(lat, lon, half_width_m)


def tile_distance_m(frame: LocalFrame, tile_id: TileId, p_map_m: F64) -> float:
    """Horizontal distance of a point (3,) of the map frame to a tile, 0 inside (to about 1 cm within 1 km)."""
    (south, west), (north, east) = tile_id.south_west_rad, tile_id.north_east_rad
    corners = frame.enu_from_geodetic(np.array([south, north]), np.array([west, east]), np.zeros(2))[:, :2]
    outside = np.maximum(0.0, np.maximum(corners[0] - p_map_m[:2], p_map_m[:2] - corners[1]))
    return float(np.hypot(*outside))


@dataclass(frozen=True, slots=True, eq=False)
class TileRectangles:
    """Tiles as rectangles of the map frame, for many distances to the same ones.

    Attributes:
        low_m, high_m: (N, 2) corners.
    """

    low_m: F64
    high_m: F64

    @classmethod
    def of(cls, frame: LocalFrame, tiles: Iterable[TileId]) -> "TileRectangles":
        """Where tiles lie in a frame."""
        return cls(*tile_boxes_m(frame, tuple(tiles)))

    def distances_m(self, p_map_m: F64) -> F64:
        """(N,) horizontal distances of a point (3,), 0 inside: `tile_distance_m` of each."""
        outside = np.maximum(0.0, np.maximum(self.low_m - p_map_m[:2], p_map_m[:2] - self.high_m))
        return np.asarray(np.hypot(outside[:, 0], outside[:, 1]))


def left_behind(frame: LocalFrame, tiles: Iterable[TileId], p_map_m: F64, distance_m: float) -> tuple[TileId, ...]:
    """Those of `tiles` that are farther away than `distance_m`."""
    some = tuple(tiles)
    away_m = TileRectangles.of(frame, some).distances_m(p_map_m)
    return tuple(some[n] for n in np.flatnonzero(away_m > distance_m))
