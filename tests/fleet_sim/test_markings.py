"""Paint of a street: drawn from its seed, changed as told, bright where it lies, and no part of anything else."""

import numpy as np
import pytest

from gnd.fleet_sim.errors import DriveSimError, WorldError
from gnd.fleet_sim.markings import PaintedBorder, paint_of, road_intensity
from gnd.fleet_sim.markings_camera import LaneCamera, border_looks
from gnd.fleet_sim.street import StreetOptions, street
from gnd.fleet_sim.world import to_json


@pytest.fixture(scope="module")
def world():
    return street(3, StreetOptions(length_m=200.0, edit_share=0.0))


@pytest.fixture(scope="module")
def paint(world):
    return paint_of(world)


def test_the_same_seed_draws_the_same_paint_and_leaves_the_world_alone(world, paint):
    before = to_json(world)
    again = paint_of(world)
    assert (again.before, again.after) == (paint.before, paint.after)
    assert to_json(world) == before


def test_every_kind_of_change_comes_and_no_change_where_none_is_wanted(world, paint):
    edits = [one.edit for one in paint.before]
    assert {"shifted", "removed", "retyped"} <= set(edits)
    assert sum(one.edit == "added" for one in paint.after) == 1
    removed = {one.name for one in paint.before if one.edit == "removed"}
    assert removed.isdisjoint(one.name for one in paint.after)
    for one in paint.after:
        was = next((old for old in paint.before if old.name == one.name), None)
        if one.edit == "shifted":
            assert 0.3 <= abs(one.y_m - was.y_m) <= 1.0
    same = paint_of(world, 0.0)
    assert same.before == same.after


def _shot(paint, y, state="before", **how):
    x = np.arange(-30.0, 30.0, 0.02)
    street_m = np.column_stack([x, np.full(len(x), y), paint.world.road_height_m(np.full(len(x), y), x)])
    points = paint.world.map_of_street(street_m)
    eyes = paint.world.map_of_street(street_m + np.array([-6.0, -1.0, 1.9]))
    return road_intensity(paint, state, points, eyes, np.random.default_rng(0), **how)


def test_paint_is_bright_and_dashes_leave_gaps(paint):
    asphalt = np.median(_shot(paint, 1.7))
    solid, dashed = _shot(paint, -3.5), _shot(paint, 0.0)
    assert np.mean(solid > 1.5 * asphalt) > 0.8
    assert 0.25 < np.mean(dashed > 1.5 * asphalt) < 0.45
    assert np.std(_shot(paint, 1.7)) > 0.0


def test_paint_is_as_wide_as_a_marking(paint):
    across = np.arange(-3.8, -3.2, 0.01)
    bright = np.array([np.median(_shot(paint, float(y))) for y in across[::4]])
    wide = 0.04 * np.sum(bright > 1.5 * np.median(_shot(paint, 1.7)))
    assert 0.08 < wide < 0.2


def test_a_wet_road_has_no_contrast(paint):
    wet = np.median(_shot(paint, -3.5, wet=True)) / max(np.median(_shot(paint, 1.7, wet=True)), 1.0)
    assert wet < 1.5 < np.median(_shot(paint, -3.5)) / np.median(_shot(paint, 1.7))


def test_far_shots_come_back_weaker(paint):
    near = _shot(paint, -3.5)
    x = np.arange(-30.0, 30.0, 0.02)
    street_m = np.column_stack([x, np.full(len(x), -3.5), paint.world.road_height_m(np.full(len(x), -3.5), x)])
    points = paint.world.map_of_street(street_m)
    eyes = paint.world.map_of_street(street_m + np.array([-30.0, 0.0, 1.9]))
    far = road_intensity(paint, "before", points, eyes, np.random.default_rng(0))
    assert far.mean() < 0.7 * near.mean()


def test_a_camera_errs_as_it_is_told_to(paint):
    T = np.tile(np.eye(4), (200, 1, 1))
    heading = paint.world.heading_rad
    T[:, :2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
    camera = LaneCamera(mount_m=0.0, mount_deg=0.0)
    looks = border_looks(camera, paint, "before", np.arange(200.0), T, 1)
    right = [xy[1] for look in looks for xy in look.xy_m if abs(xy[1] + 3.5) < 0.6]
    assert np.mean(right) == pytest.approx(-3.5, abs=0.03)
    seen = np.mean([len(look.markings) for look in looks])
    assert 2.0 < seen < 3.0  # each of three borders is missed at times
    said = [marking for look in looks for marking in look.markings]
    assert 0.25 < said.count("dashed") / len(said) < 0.5
    far = np.concatenate([look.xy_m[:, 0] for look in looks])
    assert (far > 16.0).sum() < (far < 8.0).sum()


def test_the_mount_stays_with_the_drive(paint):
    T = np.tile(np.eye(4), (50, 1, 1))
    heading = paint.world.heading_rad
    T[:, :2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
    camera = LaneCamera(mount_m=0.5, mount_deg=0.0, look_m=0.0, look_deg=0.0, point_m=0.0)
    off = []
    for seed in range(6):
        looks = border_looks(camera, paint, "before", np.arange(50.0), T, seed)
        own = np.concatenate([look.xy_m[look.line == 0, 1] for look in looks if len(look.xy_m)])
        off.append(own.mean())
        assert np.median(np.abs(own - np.median(own))) < 0.02
    assert np.std(off) > 0.1


def test_impossible_paint_and_cameras_are_refused(world):
    with pytest.raises(WorldError, match="share"):
        paint_of(world, 1.5)
    with pytest.raises(WorldError, match="runs from"):
        PaintedBorder("a", 0, 5.0, 5.0, 0.0, "solid")
    with pytest.raises(DriveSimError):
        LaneCamera(miss_near=0.9, miss_far=0.1)


def test_a_seam_is_bright_and_narrow(paint):
    assert np.median(_shot(paint, 1.0, seam_y_m=1.0)) > 1.2 * np.median(_shot(paint, 1.0))
    assert np.median(_shot(paint, 1.1, seam_y_m=1.0)) == np.median(_shot(paint, 1.1))
