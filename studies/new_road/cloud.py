"""The cloud's part, by the classes that a shard runs: surveys into the store, roads out of it; and their errors."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any, Final

import numpy as np
from scipy.spatial import cKDTree

from gnd.cloud_merger.survey.inbox import SurveyInbox
from gnd.cloud_merger.survey.mapper import RoadMapper
from gnd.cloud_merger.survey.solve import cov_sigma_m
from gnd.fleet_sim.world import World
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.codec import codec_of
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.survey import SurveyReport
from gnd.tile_store import sql_roads
from gnd.tile_store.roads import RoadTile
from gnd.tile_store.sqlite_store import SqliteStore
from studies.new_road.driving import DrivenRoad
from studies.new_road.street import MapCut, TrueSurface, axes_of, means_map_m
from studies.simulation.base_map import BaseMap

FLAT: Final = 0.08
"""A Gaussian is of a surface when its smallest standard deviation is below this [m]; others stand in corners, where no
mean lies on a surface, however good the map is."""
ROAD_NEAR_M: Final = 1.0


def map_roads(store_path: Path, base: BaseMap, drives: Sequence[DrivenRoad], received_ns: int) -> dict[str, Any]:
    """Give the drives to a new store with the cut map, one vehicle after the other; what each round made.

    Returns:
        By number of vehicles: what the mapper counted, its time, and the tiles; and under "last" the solved pieces.
    """
    store_path.unlink(missing_ok=True)
    rounds: dict[int, Any] = {}
    with SqliteStore(store_path) as store:
        store.put_tiles([Tile(t, 1, g) for t, g in sorted(base.tiles.items())])
        inbox, mapper = SurveyInbox(store), RoadMapper(store, "study")
        for number, drive in enumerate(drives, start=1):
            for key, body in zip(drive.keys, drive.bodies, strict=True):
                inbox.keep(key, SurveyReport.decode(body), received_ns + number)
            begun_s = perf_counter()
            made = mapper.map_now("ndt")
            roads = store.look(lambda c: sql_roads.tiles(c, "ndt"))
            rounds[number] = {"made": made, "seconds": perf_counter() - begun_s, "roads": roads}
        return {"rounds": rounds, "last": mapper.solved}


def map_error(
    world: World, cut: MapCut, truth: TrueSurface, tiles: Mapping[TileId, Gaussians], road: F64
) -> dict[str, Any]:
    """How far the Gaussians on the new stretches lie off the true surfaces, and how much of the road they cover."""
    means, sds, axes = [np.empty((0, 3))], [np.empty((0, 3))], [np.empty((0, 3, 3))]
    for tile, gaussians in sorted(tiles.items()):
        p = means_map_m(world, tile, gaussians)
        new = cut.is_new(world.street_of_map(p)[:, 0])
        sd, axis = axes_of(world, tile, gaussians)
        means, sds, axes = [*means, p[new]], [*sds, sd[new]], [*axes, axis[new]]
    p, sd, axis = np.concatenate(means), np.concatenate(sds), np.concatenate(axes)
    off_m, flat = truth.distances_m(p, axis), sd[:, 0] < FLAT
    near = cKDTree(p).query(road)[0] < ROAD_NEAR_M if len(p) else np.zeros(len(road), np.bool_)
    return {
        "gaussians": len(p),
        "surface_m": quantiles(off_m[flat]),
        "all_m": quantiles(off_m),
        "flat_share": float(flat.mean()) if len(p) else None,
        "road_covered": float(near.mean()),
    }


def road_places(world: World, cut: MapCut) -> F64:
    """(N, 3) places on the new stretches of both lanes, a metre apart, map frame."""
    x = np.arange(-world.half_length_m + 5.0, world.half_length_m - 5.0)
    x = x[cut.is_new(x)]
    places = [np.column_stack([x, side * world.lane_m(x)[0]]) for side in (-1, 1)]
    xy = np.concatenate(places)
    return np.asarray(world.map_of_street(np.column_stack([xy, world.road_height_m(xy[:, 1], xy[:, 0])])))


def pose_errors(world: World, solved: Sequence[Any], drives: Sequence[DrivenRoad]) -> dict[str, Any]:
    """Errors of the submaps' poses against the true ones, and how many sigmas they are."""
    true = {one.vehicle: Trajectory(one.t_ns, one.T_map_vehicle) for one in drives}
    level, up, turn, share = list[float](), list[float](), list[float](), list[float]()
    for piece in solved:
        T_map_frame, nodes = world.frame.T_self_other(piece.frame), [n for d in piece.drives for n in d.nodes]
        for n, node in enumerate(nodes):
            vehicle = piece.drives[int(piece.graph.drive_of[n])].vehicle
            off = T_inverse(true[vehicle].at(node.t_ns)) @ T_map_frame @ piece.placed.T[n]
            level.append(float(np.hypot(off[0, 3], off[1, 3])))
            up.append(abs(float(off[2, 3])))
            turn.append(abs(float(np.degrees(np.arctan2(off[1, 0], off[0, 0])))))
            share.append(float(np.linalg.norm(off[:3, 3])) / cov_sigma_m(piece.placed.covariance[n]))
    return {
        "submaps": len(level),
        "horizontal_m": quantiles(np.array(level)),
        "vertical_m": quantiles(np.array(up)),
        "heading_deg": quantiles(np.array(turn)),
        "sigmas": quantiles(np.array(share)),
    }


def quantiles(values: F64) -> dict[str, float | None]:
    """Median, 95 % quantile and largest; None of nothing."""
    if not len(values):
        return {"median": None, "p95": None, "max": None}
    return {
        "median": round(float(np.median(values)), 5),
        "p95": round(float(np.quantile(values, 0.95)), 5),
        "max": round(float(values.max()), 5),
    }


def published(roads: Sequence[RoadTile]) -> dict[TileId, Gaussians]:
    """The Gaussians that surveys have published, by tile."""
    return {one.tile: codec_of(one.codec_id).decode(one.tile, one.body) for one in roads if one.version}
