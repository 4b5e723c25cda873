"""Which thing a voxel lies at."""

from collections import Counter

import numpy as np
import pytest

from gnd.fleet_sim.shapes import Ball, Block, Post, Shape, pack
from gnd.fleet_sim.things import _gaps, things_at, things_of_voxels
from gnd.fleet_sim.truth import Truth
from gnd.fleet_sim.world import World
from gnd.gnd_map.classes import ChangeClass


@pytest.mark.parametrize(
    ("shape", "point", "gap"),
    [
        (Block(0, 0, 2, 1, 0, 3), (0.0, 0.0, 1.0), 0.0),
        (Block(0, 0, 2, 1, 0, 3), (5.0, 5.0, 1.0), 5.0),
        (Block(0, 0, 2, 1, 0, 3), (0.0, 0.0, 4.5), 1.5),
        (Block(0, 0, 2, 1, 0, 3), (5.0, 1.0, 7.0), 5.0),
        (Block(1, 0, 2, 1, 0, 3, yaw_rad=np.pi / 2), (1.0, 3.0, 1.0), 1.0),
        (Block(0, 0, 2, 1, 0, 3, rise_x=0.5), (1.0, 0.0, 4.0), 0.5),
        (Post(1, 1, 0.5, 0, 2), (4.0, 5.0, 1.0), 4.5),
        (Post(1, 1, 0.5, 0, 2), (1.0, 1.2, -3.0), 3.0),
        (Ball(0, 0, 5, 1), (0.0, 3.0, 1.0), 4.0),
        (Ball(0, 0, 5, 1), (0.0, 0.5, 5.0), 0.0),
    ],
)
def test_gaps_are_those_worked_out_by_hand(shape: Shape, point: tuple[float, float, float], gap: float) -> None:
    assert _gaps(pack([shape]), np.array([point]))[0, 0] == pytest.approx(gap)


def test_an_edited_thing_goes_before_a_kept_one_and_far_points_have_none(edited_world: World) -> None:
    street = np.array([[-3.0, 8.1, 0.4], [-9.0, 8.1, 1.0], [0.0, 0.0, 0.1], [0.0, 0.0, 20.0]])
    found = things_at(edited_world, edited_world.map_of_street(street))
    names = [edited_world.objects[index].name if index >= 0 else "" for index in found]
    assert names == ["goes", "stays", "ground", ""]


def test_changed_voxels_lie_at_edited_things(edited: Truth, edited_world: World) -> None:
    rows = np.flatnonzero(edited.clear & (edited.change_class == ChangeClass.DELETED))
    found = things_of_voxels(edited_world, edited, rows)
    names = Counter(edited_world.objects[index].name for index in found if index >= 0)
    assert names["goes"] + names["moves"] > 0.9 * len(rows)
