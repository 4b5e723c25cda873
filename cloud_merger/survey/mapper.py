"""The room in which surveys become roads: parts that have come are put together, solved, fused and judged.

One shard at a time works on a layer (a lease in the store). All is made anew from the parts that the store keeps, so a
shard that is killed leaves nothing half done: what it has published is a version like any other.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from gnd.cloud_merger.survey.drives import SurveyedDrive, drives_of, first_poses
from gnd.gnd_map.arrays import are_in
from gnd.gnd_map.codec import LATTICES, best_codec, codec_of, snap
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.gaussian import Gaussians, concat
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId, covering_corridor
from gnd.schemas.errors import SchemaError
from gnd.schemas.survey import SurveyReport
from gnd.tile_store import clocks, sql_roads
from gnd.tile_store.errors import DistrictElsewhere, StoreError
from gnd.tile_store.roads import OpenRoads, RoadTile
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.values import DEFAULT_CODEC, lattice_named

if TYPE_CHECKING:  # and where a road is mapped: GTSAM is dear to load, and most shards are sent no surveys
    from gnd.cloud_merger.survey.fuse import FusedTile
    from gnd.cloud_merger.survey.solve import SolvedPiece

QUIET_S: Final = 2.0
"""Parts are waited for until none has come for so long ..."""
LONGEST_S: Final = 20.0
"""... or the first has waited for so long."""
LEASE_S: Final = 600.0
AROUND_M: Final = 60.0
"""The published map is looked at so far around the ways."""
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RoadsMapped:
    """What one round has made: pieces, tiles by state, versions, tiles whose turn comes later, pieces that failed."""

    pieces: int = 0
    draft: int = 0
    waiting: int = 0
    published: int = 0
    versions: int = 0
    postponed: int = 0
    failed: int = 0


class RoadMapper:
    """Maps roads from surveys.

    Args:
        store: of surveys and tiles.
        owner: name of the shard.
        on_published: called after versions are durable.
        now_ns: the clock, int ns UTC.
        codec: lattice of what is published, as for merged tiles.

    Attributes:
        solved: the pieces of the last round, for those who look at how good they are.
    """

    def __init__(
        self,
        store: SqlStore,
        owner: str,
        on_published: Callable[[], object] = lambda: None,
        now_ns: Callable[[], int] = clocks.day_ns,
        codec: str = DEFAULT_CODEC,
    ) -> None:
        self._store, self._owner, self._on_published, self._now_ns = store, owner, on_published, now_ns
        self.solved: list[SolvedPiece] = []
        self._lattice = lattice_named(codec) or LATTICES[DEFAULT_CODEC]

    def work(self) -> int:
        """Map the layers of which enough parts have come; how many were.

        Raises:
            StoreError: the store has failed; the lease runs out.
        """
        done = 0
        for roads in self._store.look(sql_roads.open_roads):
            if self._is_ready(roads) and self._leased(roads.layer):
                done += self._attempt(roads)
        return done

    def map_now(self, layer: str) -> RoadsMapped:
        """Map a layer with all parts that are there, ready or not."""
        parts = self._store.look(lambda c: sql_roads.parts(c, layer))
        pieces = pieces_of(drives_of(_readable(parts)))
        total, self.solved = RoadsMapped(), []
        for piece in pieces:
            total = _sum(total, self._tried(layer, piece))
        if total.versions:
            self._on_published()
        return replace(total, pieces=len(pieces))

    def _is_ready(self, roads: OpenRoads) -> bool:
        now = self._now_ns()
        return now - roads.newest_ns > QUIET_S * 1e9 or now - roads.oldest_ns > LONGEST_S * 1e9

    def _leased(self, layer: str) -> bool:
        return self._store.transact(lambda c, _: sql_roads.lease(c, layer, self._owner, LEASE_S))

    def _attempt(self, roads: OpenRoads) -> int:
        """Map what a lease is held for, and give the layer back."""
        made = self.map_now(roads.layer)
        _LOG.info("roads of layer %s: %s", roads.layer, made)
        done = None if made.postponed else roads.arrival
        self._store.transact(lambda c, _: sql_roads.settle(c, roads.layer, self._owner, done))
        return int(done is not None)

    def _tried(self, layer: str, drives: Sequence[SurveyedDrive]) -> RoadsMapped:
        """Map a piece; one that fails does not stop the others, and is tried again when other parts come."""
        try:
            return self._map_piece(layer, drives)
        except StoreError:
            raise
        except (GndError, RuntimeError, ValueError, np.linalg.LinAlgError):
            surveys = sorted({drive.survey_id for drive in drives})
            _LOG.exception("roads of layer %s cannot be mapped from surveys %s", layer, ", ".join(surveys))
            return RoadsMapped(failed=1)

    def _map_piece(self, layer: str, drives: Sequence[SurveyedDrive]) -> RoadsMapped:
        from gnd.cloud_merger.survey.fuse import fuse_piece
        from gnd.cloud_merger.survey.solve import solve_piece

        frame = frame_of(drives[0])
        if frame is None:
            return RoadsMapped()
        known = {one.tile: one for one in self._store.look(lambda c: sql_roads.tiles(c, layer))}
        before, heads = self._published(layer, drives, known)
        piece = solve_piece(drives, before, frame)
        if piece is None:
            return RoadsMapped()
        self.solved.append(piece)
        _LOG.info("a piece of %d drives: matches %s, left out %s, doubts %s", len(drives), dict(piece.fate),
                  dict(piece.left_out), dict(piece.doubts))  # fmt: skip
        total = RoadsMapped()
        for one in fuse_piece(piece, before):
            try:
                total = _sum(total, self._write(layer, one, piece, before, heads, known.get(one.tile)))
            except DistrictElsewhere as error:
                _LOG.warning("the road in tile %s is not entered: %s", one.tile, error)
        return total

    def _published(
        self, layer: str, drives: Sequence[SurveyedDrive], known: Mapping[TileId, RoadTile]
    ) -> tuple[dict[TileId, Tile], dict[TileId, int]]:
        """The map around as it was before any survey, and the versions of the heads."""
        before, heads = dict[TileId, Tile](), dict[TileId, int]()
        for tile_id in sorted(set[TileId]().union(*(tiles_of(drive) for drive in drives))):
            head = self._store.get(layer, tile_id)
            heads[tile_id] = 0 if head is None else head.version
            road = known.get(tile_id)
            if road is not None and road.version:
                head = self._store.get(layer, tile_id, road.base_version) if road.base_version else None
            if head is not None:
                before[tile_id] = head.decode_gaussians()
        return before, heads

    def _write(
        self,
        layer: str,
        one: "FusedTile",
        piece: "SolvedPiece",
        before: Mapping[TileId, Tile],
        heads: Mapping[TileId, int],
        known: RoadTile | None,
    ) -> RoadsMapped:
        """Write what a tile has become; publish it where it is good."""
        from gnd.cloud_merger.survey.verdict import verdict

        state, reason = verdict(one, _told(piece))
        new = one.gaussians.take(one.agreed) if state == "published" else one.gaussians
        new = snap(new, self._lattice) if len(new) else new
        codec_id = best_codec(new)
        head = heads.get(one.tile, 0)
        road = RoadTile(
            layer, one.tile, state, reason, len(one.drives), one.vehicles, min(one.sigma_m, 1e6), one.apart_m,
            int(one.agreed.sum()), int((~one.agreed).sum()), one.first_ns, one.last_ns, 0,
            known.base_version if known is not None else head, known.version if known is not None else 0, codec_id,
            codec_of(codec_id).encode(one.tile, new),
        )  # fmt: skip
        if known is not None and known.version and known.version != head:
            return RoadsMapped(published=1)  # reports have been merged into it since: what is seen there goes that way
        if state != "published":
            if known is None or not known.version:  # what is published stays, even where a new drive disagrees
                self._store.transact(lambda c, now: sql_roads.put_tile(c, road, now))
            return RoadsMapped(draft=int(state == "draft"), waiting=int(state == "waiting"))
        tile = Tile(one.tile, head + 1, _joined(before.get(one.tile), new))
        if known is not None and known.version and self._is_head(layer, tile):
            return RoadsMapped(published=1)
        version = self._store.transact(lambda c, now: sql_roads.publish(c, road, tile, head, now, self._store.signing))
        return RoadsMapped(published=1, versions=1) if version is not None else RoadsMapped(postponed=1)

    def _is_head(self, layer: str, tile: Tile) -> bool:
        head = self._store.get(layer, tile.tile_id)
        return head is not None and head.sha == tile.sha


def _joined(before: Tile | None, new: Gaussians) -> Gaussians:
    """What the tile held, and what is new: of a voxel in both the old one stays."""
    if before is None:
        return new
    held = before.gaussians
    return concat([held, new.take(~are_in(new.voxel_id, held.voxel_id))])


def _told(piece: "SolvedPiece") -> str:
    return "; ".join(f"{piece.drives[k].vehicle} does not count: {why}" for k, why in sorted(piece.doubts.items()))


def _sum(a: RoadsMapped, b: RoadsMapped) -> RoadsMapped:
    return RoadsMapped(*(getattr(a, name) + getattr(b, name) for name in RoadsMapped.__slots__))


def _readable(parts: Sequence[tuple[int, bytes]]) -> list[SurveyReport]:
    """The parts; one that can no longer be read is left out."""
    found = []
    for arrival, body in parts:
        try:
            found.append(SurveyReport.decode(body))
        except SchemaError as error:
            _LOG.error("part %d of the surveys cannot be read any more and is left out: %s", arrival, error)
    return found


def frame_of(drive: SurveyedDrive) -> LocalFrame | None:
    """A frame near a drive: that of the tile of an anchor, else of a fix; None without either."""
    for node in drive.nodes:
        for anchor in node.anchors:
            return LocalFrame.of_tile(anchor.tile)
    for node in drive.nodes:
        for fix in node.fixes:
            return LocalFrame.of_tile(TileId.from_geodetic(fix.lat_rad, fix.lon_rad))
    return None


def tiles_of(drive: SurveyedDrive) -> frozenset[TileId]:
    """The tiles around the way of a drive, as it is thought to be before anything is solved."""
    frame = frame_of(drive)
    T = None if frame is None else first_poses(drive, frame)
    if frame is None or T is None:
        return frozenset()
    lat, lon, _ = frame.geodetic_from_enu(T[:, :3, 3])
    return frozenset(covering_corridor(lat, lon, AROUND_M))


def pieces_of(drives: Sequence[SurveyedDrive]) -> list[list[SurveyedDrive]]:
    """Drives that come near each other, directly or through others, together; those without a place are left out."""
    pieces: list[tuple[set[TileId], list[SurveyedDrive]]] = []
    for drive in drives:
        tiles = set(tiles_of(drive))
        if not tiles:
            continue
        joined, apart = [drive], []
        for other_tiles, members in pieces:
            if tiles.isdisjoint(other_tiles):
                apart.append((other_tiles, members))
            else:
                tiles, joined = tiles | other_tiles, [*members, *joined]
        pieces = [*apart, (tiles, joined)]
    return [members for _, members in pieces]
