"""A short street with one wall that stays, one box that goes and one that comes; and scans of it."""

import numpy as np

from gnd.fleet_sim import parts
from gnd.fleet_sim.dense_rays import ScanPlan
from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.shapes import Block
from gnd.fleet_sim.street import BORDER_LON_RAD, LAT_RAD
from gnd.fleet_sim.world import World, WorldObject

PLAN = ScanPlan(spacing_m=1.0, step_rad=np.radians(0.6), end_margin_m=1.0)
STAYS, GOES, COMES = (-6.0, -2.0, 6.0, 6.4), (1.0, 3.5, 6.0, 8.0), (-2.0, 1.5, -8.0, -6.0)  # x0, x1, y0, y1 street


def box_world() -> World:
    ground = Block(0.0, 0.0, 40.0, 40.0, -3.0, 0.0, reflectivity=parts.ASPHALT)
    objects = [WorldObject("ground", "ground", ("before", "after"), "kept", (ground,))]
    boxes = (("stays", ("before", "after"), "kept", STAYS), ("goes", ("before",), "removed", GOES))
    for name, states, edit, (x0, x1, y0, y1) in (*boxes, ("comes", ("after",), "added", COMES)):
        objects.append(WorldObject(name, "box", states, edit, (parts.slab(x0, x1, y0, y1, -0.1, 2.4),)))
    return World(
        seed=0, lat_rad=LAT_RAD, lon_rad=BORDER_LON_RAD, height_m=30.3, heading_rad=0.5, slope=0.015, crown=0.0,
        half_length_m=10.0, lane_offset_m=1.75, kerb_m=6.2, objects=tuple(objects),
    )  # fmt: skip


def scans(world: World, seed: int, sigma_m: float = 0.02):
    """(points, origins) of a drive through the state after, with range noise."""
    rng = np.random.default_rng(seed)
    scene = Scene.build(world.shapes("after"), world.A_street_map)
    for x in np.arange(-9.0, 9.0, 0.5) + rng.uniform(0.0, 0.5):
        origin = world.map_of_street(np.array([[x, -1.75, 1.9]]))[0]
        azimuth = rng.uniform(-np.pi, np.pi, 4000)
        elevation = np.radians(rng.integers(-15, 12, 4000) + rng.uniform(0.0, 1.0))
        flat = np.cos(elevation)
        d = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)
        ranges, _ = scene.cast(origin, d, 40.0)
        hit = np.isfinite(ranges)
        ends = origin + (ranges[hit] + sigma_m * rng.standard_normal(hit.sum()))[:, None] * d[hit]
        yield ends, np.broadcast_to(origin, ends.shape).copy()


def inside(world: World, points_m: np.ndarray, box, margin_m: float) -> np.ndarray:
    """Which points (N, 3), map frame, lie in a box grown by a margin, above the ground."""
    p = world.street_of_map(np.asarray(points_m, np.float64))
    x0, x1, y0, y1 = box
    across = (p[:, 0] >= x0 - margin_m) & (p[:, 0] <= x1 + margin_m)
    return across & (p[:, 1] >= y0 - margin_m) & (p[:, 1] <= y1 + margin_m) & (p[:, 2] > 0.3)
