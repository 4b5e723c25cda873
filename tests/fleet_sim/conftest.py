"""Worlds that several tests look at."""

from pathlib import Path

import pytest
from sim_worlds import BOTH, COARSE, small_world, thing

from gnd.fleet_sim import parts
from gnd.fleet_sim.street import street
from gnd.fleet_sim.truth import Truth, load_or_make_truth, make_truth
from gnd.fleet_sim.world import World


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
        thing("revealed", BOTH, "kept", wall(-3.8, -2.2, 9.0, 9.3, -0.2, 1.6)),
    )


@pytest.fixture(scope="session")
def edited(edited_world: World) -> Truth:
    """The truth of the edited world, from a coarse scan."""
    return make_truth(edited_world, plan=COARSE)


@pytest.fixture(scope="session")
def truth_1(street_1: World, tmp_path_factory: pytest.TempPathFactory) -> tuple[Truth, Path]:
    """The truth of the street of seed 1, and its file; about 15 s of work, done once."""
    path = tmp_path_factory.mktemp("truth") / "truth.npz"
    return load_or_make_truth(street_1, path), path
