"""Small worlds made by hand."""

import numpy as np

from gnd.fleet_sim import parts
from gnd.fleet_sim.dense_scan import ScanPlan
from gnd.fleet_sim.shapes import Block, Shape
from gnd.fleet_sim.street import BORDER_LON_RAD, LAT_RAD
from gnd.fleet_sim.world import Edit, State, World, WorldObject

COARSE = ScanPlan(spacing_m=1.0, step_rad=np.radians(0.7), end_margin_m=1.0)
BOTH: tuple[State, ...] = ("before", "after")


def thing(name: str, states: tuple[State, ...], edit: Edit, *shapes: Shape) -> WorldObject:
    return WorldObject(name, "thing", states, edit, shapes)


def small_world(*objects: WorldObject, slope: float = 0.015, half_length_m: float = 12.0) -> World:
    """A short street with nothing on it but its ground and `objects`."""
    ground = Block(0.0, 0.0, 70.0, 60.0, -3.0, 0.0, reflectivity=parts.ASPHALT)
    return World(
        seed=0,
        lat_rad=LAT_RAD,
        lon_rad=BORDER_LON_RAD,
        height_m=30.3,
        heading_rad=0.5,
        slope=slope,
        crown=0.0,
        half_length_m=half_length_m,
        lane_offset_m=1.75,
        kerb_m=6.2,
        objects=(thing("ground", BOTH, "kept", ground), *objects),
    )
