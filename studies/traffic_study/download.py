"""The map on its way to a vehicle along its drive: the vehicle's plan, the tile server's answers, every byte booked."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

import numpy as np

from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_sim.drives import DriveSimulation
from gnd.fleet_sim.sensors import MODELS
from gnd.fleet_sim.world import World
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.codec import PREFERRED
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas.keys import batch_key
from gnd.schemas.tiles_batch import HeldVersion, TilesReply, TilesRequest
from gnd.tile_store.answers import TileAnswers
from gnd.tile_store.sqlite_store import SqliteStore, SqlStore
from gnd.tile_store.values import DEFAULT_LAYER
from gnd.vehicle_agent.config import LEAD_S, DownloadParameters
from gnd.vehicle_agent.link.download import DOWNLOAD_BATCH_S
from gnd.vehicle_agent.link.plan import VehicleCourse, batch_bytes, needs
from gnd.vehicle_agent.surroundings import AHEAD_S, STEP_M, tiles_along
from studies.traffic_study.fleet import drive_config
from studies.traffic_study.options import TrafficOptions

_LOOK_S: Final = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class DownloadTrack:
    """A drive every `STEP_M` of way: time [s], way [m], position (N, 3) and velocity (N, 2), map frame."""

    frame: LocalFrame
    t_s: F64
    way_m: F64
    position_m: F64
    velocity_mps: F64

    @classmethod
    def of(cls, world: World, options: TrafficOptions) -> Self:
        """The first drive of a study."""
        simulation = DriveSimulation(world, drive_config(options, 0))
        t_s = np.arange(0.0, simulation.scans / MODELS[options.sensor_model].rate_hz, _LOOK_S)
        position_m = simulation.motion.T_map_vehicle(t_s)[:, :3, 3]
        steps_m = np.linalg.norm(np.diff(position_m, axis=0), axis=1)
        way_m = np.concatenate([[0.0], np.cumsum(steps_m)])
        at = np.unique(np.searchsorted(way_m, np.arange(0.0, way_m[-1], STEP_M)))
        velocity_mps = np.gradient(position_m[:, :2], t_s, axis=0)
        return cls(world.frame, t_s[at], way_m[at], position_m[at], velocity_mps[at])

    @property
    def km(self) -> float:
        """Length of the drive, kilometres."""
        return float(self.way_m[-1]) / 1e3


@dataclass(frozen=True, slots=True)
class Question:
    """One question about tiles and its answer.

    Attributes:
        t_s, way_m: when and where on the drive.
        up_bytes, down_bytes: key and question; answer.
        fetched: tiles that it brought, or of which it said that nothing has changed.
    """

    t_s: float
    way_m: float
    up_bytes: int
    down_bytes: int
    fetched: tuple[TileId, ...]


class Server:
    """The tile server's answers from a store, without a bus."""

    def __init__(self, store: SqlStore) -> None:
        self._answers: Final = TileAnswers(store)

    def ask(self, district: District, request: TilesRequest) -> tuple[int, int, TilesReply]:
        """Return the bytes up (with the key), the bytes down, and the answer as the vehicle reads it."""
        key, question = batch_key(DEFAULT_LAYER, district), request.encode()
        answer = self._answers.many(DEFAULT_LAYER, district, TilesRequest.decode(question)).encode()
        return len(key) + len(question), len(answer), TilesReply.decode(answer)


def along_drive(
    track: DownloadTrack,
    server: Server,
    link: LinkProfile,
    *,
    held: Mapping[TileId, Tile] | None = None,
    codecs: tuple[int, ...] = PREFERRED,
) -> list[Question]:
    """Every question that a vehicle asks about tiles on a drive, and its answer.

    The vehicle plans as `vehicle_agent.surroundings` does: when something is needed soon it asks for all that is ahead,
    soonest first, in batches of a district that the link carries in a moment.

    Args:
        track: the drive.
        server: which answers.
        link: by whose rate batches are sized.
        held: what it has from an earlier drive.
        codecs: that it reads, best first.
    """
    parameters, held, known = DownloadParameters(), held or {}, set[TileId]()
    most = batch_bytes(link.rate_byte_s("down"), DOWNLOAD_BATCH_S)
    questions: list[Question] = []
    for k in range(len(track.t_s)):
        waiting = _due(track, k, parameters, known)
        while waiting:
            tiles = [tile for tile in waiting if tile.district == waiting[0].district]
            asked = [HeldVersion(t, held[t].version, held[t].sha) if t in held else HeldVersion(t) for t in tiles]
            request = TilesRequest.of(asked, codecs=codecs, max_bytes=most, near=tiles[0])
            up, down, reply = server.ask(tiles[0].district, request)
            answered = reply.of_request(request, tiles[0].district)
            fetched = tuple(tile for tile, answer in answered if answer.status not in ("later", "hash"))
            questions.append(Question(float(track.t_s[k]), float(track.way_m[k]), up, down, fetched))
            known.update(fetched)
            waiting = [tile for tile in waiting if tile not in known]
    return questions


def _due(track: DownloadTrack, k: int, parameters: DownloadParameters, known: set[TileId]) -> list[TileId]:
    """The tiles to ask for now, soonest needed first; none while nothing is urgent."""
    here, velocity = track.position_m[k], track.velocity_mps[k]
    speed = float(np.hypot(*velocity))
    heading = float(np.arctan2(velocity[1], velocity[0]))
    ahead_m = max(parameters.ahead_m, AHEAD_S * speed)
    end = here + ahead_m * np.array([np.cos(heading), np.sin(heading), 0.0])
    tiles = tiles_along(track.frame, np.stack([here, end]), parameters.near_m)
    planned = needs(
        track.frame, tiles, VehicleCourse(float(here[0]), float(here[1]), heading, speed), parameters.near_m
    )
    new = [need for need in planned if need.tile_id not in known]
    return [need.tile_id for need in new] if any(need.from_s <= LEAD_S for need in new) else []


def total_bytes(questions: Iterable[Question]) -> int:
    """Questions with keys, and answers."""
    return sum(question.up_bytes + question.down_bytes for question in questions)


def fetched_tiles(questions: Iterable[Question]) -> tuple[TileId, ...]:
    """The tiles of a drive, in order."""
    return tuple(tile for question in questions for tile in question.fetched)


def store_of(path: Path, *states: Mapping[TileId, Gaussians]) -> SqlStore:
    """A new store with one version a state, the oldest first; an older store there is removed."""
    for old in path.parent.glob(f"{path.name}*"):
        old.unlink()
    store = SqliteStore(path)
    for number, state in enumerate(states, start=1):
        store.put_tiles(Tile(tile, number, gaussians) for tile, gaussians in state.items())
    return store


def partly_changed(tiles: Mapping[TileId, Gaussians], share: float, seed: int) -> dict[TileId, Gaussians]:
    """The map with a share of each tile's voxels changed, here and there: half of them hold another Gaussian of the
    tile, a quarter is gone, and as many are new, beside others.

    Args:
        tiles: on one lattice; what changes stays on it.
        share: of the tile's voxels; at least one changes in each tile.
        seed: decides which.
    """
    return {
        tile: _changed(gaussians, share, np.random.default_rng([seed, tile.morton]))
        for tile, gaussians in tiles.items()
    }


def _changed(gaussians: Gaussians, share: float, rng: np.random.Generator) -> Gaussians:
    n = max(1, round(share * len(gaussians)))
    at, other = rng.permutation(len(gaussians))[:n], rng.integers(0, len(gaussians), n)
    modified, gone, new = np.split(at, [(n + 1) // 2, n - n // 4])
    source = np.arange(len(gaussians))
    source[modified] = other[: len(modified)]
    voxel_id = gaussians.voxel_id.copy()
    free = np.setdiff1d(voxel_id[new] + 1, voxel_id)
    kept = np.setdiff1d(np.arange(len(gaussians)), gone)
    ids = np.concatenate([voxel_id[kept], free]).astype(np.int32)
    rows = np.concatenate([source[kept], other[: len(free)]])
    order = np.argsort(ids)
    columns = (ids, *(getattr(gaussians, name)[rows] for name in ("count", "cells", "mean_m", "cov_m2")))
    return Gaussians(*(column[order] for column in columns))
