"""What glass, rain and the width of beams do to returns, each against what geometry says."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from sim_worlds import BOTH, small_world, thing

from gnd.fleet_sim import parts
from gnd.fleet_sim.drives import PERFECT, DriveConfig, DriveSimulation
from gnd.fleet_sim.errors import DriveSimError
from gnd.fleet_sim.lidar import Lidar
from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.sensing import Beams, Disturbance, Shots, Weather
from gnd.fleet_sim.sensors import VLP16
from gnd.fleet_sim.shapes import Shape
from gnd.fleet_sim.street import StreetOptions, street
from gnd.fleet_sim.world import World, WorldObject
from gnd.schemas.drive import Scan

EYE_M = np.array([0.0, 0.0, 1.9])


def yard(*things: WorldObject) -> World:
    """A flat yard with walls on three sides; the fourth, to the left, is left to `things`."""
    walls = [
        thing("right", BOTH, "kept", parts.slab(-30, 30, -12.3, -12.0, -0.2, 8.0)),
        thing("ahead", BOTH, "kept", parts.slab(20.0, 20.3, -12, 12, -0.2, 8.0)),
        thing("behind", BOTH, "kept", parts.slab(-20.3, -20.0, -12, 12, -0.2, 8.0)),
    ]
    world = small_world(*walls, *things, slope=0.0)
    ground = replace(world.objects[0], kind="road")
    return replace(world, objects=(ground, *world.objects[1:]), heading_rad=0.0)


def met(world: World, weather: Weather = "clear", beams: Beams = "ideal", t_s: float = 0.0) -> tuple[np.ndarray, ...]:
    """Directions, ranges without and with the disturbance, primitives without and with it, for a VLP-16 that stands."""
    scene, lidar = Scene.build(world.shapes("after"), world.A_street_map), Lidar(VLP16)
    T = np.eye(4)
    T[:3, 3] = EYE_M
    poses = np.tile(T, (VLP16.columns + 1, 1, 1))
    hits = lidar.hits(scene, poses)
    ranges, primitive, incidence = hits.range_m.copy(), hits.primitive.copy(), hits.incidence.copy()
    shots = Shots(poses[:, :3], VLP16.directions(), VLP16.shares, VLP16.range_max_m)
    disturbance = Disturbance(world, "after", weather, beams, (7, 0))
    disturbance.disturb(scene, scene.packed, shots, t_s, (ranges, primitive, incidence))
    return VLP16.directions(), hits.range_m, ranges, hits.primitive, primitive


def change(ranges: np.ndarray, plain: np.ndarray) -> np.ndarray:
    """Ranges less what they were, infinite where only one of them is a return."""
    both = np.isfinite(ranges) & np.isfinite(plain)
    difference = np.where(both, ranges, 0.0) - np.where(both, plain, 0.0)
    return np.where(both | (np.isinf(ranges) & np.isinf(plain)), difference, np.inf)


def test_without_glass_rain_and_width_nothing_acts() -> None:
    assert not Disturbance(yard(), "after", "clear", "ideal", (1,)).acts
    _, plain, ranges, before, after = met(yard())
    np.testing.assert_array_equal(plain, ranges)
    np.testing.assert_array_equal(before, after)


def test_the_plain_twin_of_the_shots_gives_the_rays_that_were_cast() -> None:
    world = yard()
    scene = Scene.build(world.shapes("after"), world.A_street_map)
    T = np.tile(np.eye(4), (VLP16.columns + 1, 1, 1))
    T[:, :3, 3] = EYE_M + np.linspace(0.0, 0.9, len(T))[:, None] * np.array([1.0, 0.1, 0.0])
    hits = Lidar(VLP16).hits(scene, T)
    column, beam = np.nonzero(hits.primitive >= 0)
    origin, direction = Shots(T[:, :3], VLP16.directions(), VLP16.shares, 100.0).rays(column, beam)
    for k in range(0, len(column), 4001):
        ranges, _ = scene.cast(origin[k], direction[k : k + 1], 100.0)
        assert ranges[0] == pytest.approx(hits.range_m[column[k], beam[k]], abs=1e-9)


def test_glass_mirrors_or_shows_the_room_behind_or_nothing() -> None:
    pane = WorldObject("pane", "glass", BOTH, "kept", (parts.slab(-18, 18, 8.0, 8.1, -0.2, 6.0),))
    directions, plain, ranges, primitive, _ = met(yard(pane))
    number = next(k for k, o in enumerate(yard(pane).objects) if o.kind == "glass")
    of_glass = primitive == number
    np.testing.assert_array_equal(ranges[~of_glass], plain[~of_glass])
    away = ranges[of_glass] - plain[of_glass]
    unchanged, lost = away == 0.0, ~np.isfinite(away)
    assert 0.08 < unchanged.mean() < 0.35
    assert 0.1 < lost.mean() < 0.6
    room = np.isclose(away, 4.0 / directions[of_glass][:, 1], atol=1e-6)
    assert 0.1 < room.mean() < 0.5
    mirrored = ~unchanged & ~lost & ~room
    assert mirrored.mean() > 0.1
    ghost = EYE_M + directions[of_glass][mirrored] * ranges[of_glass][mirrored][:, None]
    back = ghost * np.array([1.0, -1.0, 1.0]) + np.array([0.0, 16.0, 0.0])
    on_wall = np.abs(back[:, 1] + 12.0) < 0.01
    on_wall |= np.abs(np.abs(back[:, 0]) - 20.0) < 0.01
    on_wall |= np.abs(back[:, 2]) < 0.01
    assert on_wall.mean() > 0.99, "what a mirror shows is what stands before it"


def test_a_wet_road_swallows_flat_shots_and_mirrors_some() -> None:
    world = yard()
    directions, plain, ranges, primitive, _ = met(world, "rain")
    road = primitive == 0
    far, near = road & (plain > 15.0), road & (plain < 8.0)
    changed = ranges != plain
    assert changed[far].mean() > changed[near].mean() + 0.2
    ghosts = road & np.isfinite(ranges) & (ranges > plain + 0.01)
    depth = EYE_M[2] + directions[ghosts][:, 2] * ranges[ghosts]
    assert ghosts.sum() > 20
    assert (depth < 0.0).all(), "mirrored things seem to lie under the road"
    walls = np.abs(EYE_M + directions[ghosts] * ranges[ghosts][:, None])
    assert ((np.abs(walls[:, 1] - 12.0) < 0.01) | (np.abs(walls[:, 0] - 20.0) < 0.01)).mean() > 0.99


def test_rain_takes_far_returns_and_gives_some_of_its_own() -> None:
    _, plain, ranges, primitive, _ = met(yard(), "rain")
    wall = primitive > 0
    lost = wall & ~np.isfinite(ranges)
    expected = 1.0 - np.exp(-2 * 0.004 * plain[wall]).mean()
    assert lost.sum() / wall.sum() == pytest.approx(expected, abs=0.02)
    drops = np.isfinite(ranges) & (ranges < plain - 0.5)
    assert 0.002 < drops.mean() < 0.006
    assert (ranges[drops] >= 1.0).all()


def test_real_beams_mix_pixels_at_edges_only() -> None:
    box = thing("box", BOTH, "kept", parts.slab(4.0, 6.0, 7.0, 8.0, -0.2, 4.0))
    wall = thing("left", BOTH, "kept", parts.slab(-19, 19, 8.5, 8.8, -0.2, 8.0))
    _, plain, ranges, *_ = met(yard(box, wall), beams="real")
    moved = np.abs(change(ranges, plain)) > 0.1
    step = np.abs(change(plain[1:], plain[:-1]))
    edge = (step > 0.25) & (step < 2.0)
    beside = np.zeros_like(moved)
    beside[:-1] |= edge
    beside[1:] |= edge
    assert moved.sum() > 5
    assert not (moved & ~beside).any()
    assert 0.1 < moved[beside].mean() < 0.5


def test_real_beams_are_short_on_slanting_surfaces() -> None:
    _, plain, ranges, primitive, _ = met(yard(), beams="real")
    road = (primitive == 0) & (np.abs(change(ranges, plain)) < 0.1)
    bias = change(ranges, plain)[road]
    assert (bias <= 0.0).all()
    assert (bias >= -0.06 - 1e-9).all()
    assert bias[plain[road] > 12.0].mean() < bias[plain[road] < 7.5].mean() - 0.01


def test_a_sign_answers_to_shots_beside_it() -> None:
    plate: Shape = parts.slab(9.0, 9.04, 2.0, 3.0, 1.0, 3.0, parts.SIGN)
    world = yard(thing("sign", BOTH, "kept", plate))
    _, _, _, primitive, after = met(world, beams="real")
    sign = len(world.objects) - 1
    assert world.objects[sign].name == "sign"
    grown = (after == sign) & (primitive != sign)
    assert 3 <= grown.sum() <= 6 * (primitive == sign).any(axis=0).sum()
    columns = np.flatnonzero((primitive == sign).any(axis=1))
    assert set(np.flatnonzero(grown.any(axis=1)).tolist()) <= {c + k for c in columns.tolist() for k in (-2, -1, 1, 2)}


def scans(**options: object) -> Iterator[np.ndarray]:
    config = DriveConfig("car", "VLP-16", scans=3, errors=PERFECT, **options)  # type: ignore[arg-type]
    simulation = DriveSimulation(street(1, StreetOptions(100.0)), config)
    return (item.points_m for item in simulation.items() if isinstance(item, Scan))


def test_a_disturbed_drive_is_reproducible_and_another_than_the_plain_one() -> None:
    plain, rain, again = (list(scans(weather=w)) for w in ("clear", "rain", "rain"))
    assert [len(s) for s in rain] == [len(s) for s in again]
    assert all(np.array_equal(a, b) for a, b in zip(rain, again, strict=True))
    assert all(len(r) < 0.95 * len(p) for r, p in zip(rain, plain, strict=True))


def test_unknown_weather_is_refused() -> None:
    with pytest.raises(DriveSimError, match="hail"):
        DriveConfig("car", "VLP-16", weather="hail")  # type: ignore[arg-type]
    with pytest.raises(DriveSimError, match="stay_h"):
        DriveConfig("car", "VLP-16", stay_h=-1.0)
