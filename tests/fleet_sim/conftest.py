"""Worlds that several tests look at."""

from pathlib import Path

import numpy as np
import pytest

from fleet_sim import parts
from fleet_sim.dense_scan import ScanPlan
from fleet_sim.shapes import Block, Shape
from fleet_sim.street import BORDER_LON_RAD, LAT_RAD, street
from fleet_sim.truth import Truth, load_or_make_truth
from fleet_sim.world import Edit, State, World, WorldObject

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


@pytest.fixture(scope="session")
def street_1() -> World:
    return street(1)


@pytest.fixture(scope="session")
def edited_world() -> World:
    """A wall that goes, one that comes, one that moves by 0.5 m, one that a container hides, one that is revealed."""
    wall = parts.slab
    return small_world(
        thing("stays", BOTH, "kept", wall(-11, -7, 8.0, 8.3, -0.2, 3.0)),
        thing("goes", ("before",), "removed", wall(-5, -1, 8.0, 8.3, -0.2, 3.0)),
        thing("comes", ("after",), "added", wall(1, 5, 8.0, 8.3, -0.2, 3.0)),
        thing("moves", ("before",), "moved", wall(-11, -5, -8.3, -8.0, -0.2, 3.0)),
        thing("moves", ("after",), "moved", wall(-11, -5, -8.8, -8.5, -0.2, 3.0)),
        thing("hidden", BOTH, "kept", wall(0, 3, -9.4, -9.1, -0.2, 2.0)),
        thing("container", ("after",), "added", wall(-0.6, 3.6, -8.6, -6.2, -0.2, 2.6)),
        thing("revealed", BOTH, "kept", wall(-4, -2, 11.0, 11.3, -0.2, 2.0)),
    )


COARSE = ScanPlan(spacing_m=1.0, step_rad=np.radians(0.7), end_margin_m=1.0)


@pytest.fixture(scope="session")
def truth_1(street_1: World, tmp_path_factory: pytest.TempPathFactory) -> tuple[Truth, Path]:
    """The truth of the street of seed 1, and its file; about 15 s of work, done once."""
    path = tmp_path_factory.mktemp("truth") / "truth.npz"
    return load_or_make_truth(street_1, path), path
