"""Compile or load every kernel that a vehicle uses, before processes are forked: each child then shares the pages."""

from dataclasses import replace

import numpy as np

from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.codec import encode_mask
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.gnd_map.track_builder import TrackBuilder
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.drive import GnssFix, MotionSample, Scan
from gnd.schemas.report_id import deterministic_report_id
from gnd.vehicle_agent.detect.classify import classify, tile_change
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.detect.recent_map import recent_map
from gnd.vehicle_agent.detect.trial import Trial
from gnd.vehicle_agent.features.poles.detector import PoleDetector
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.clock import MotionSignal, solve_chain
from gnd.vehicle_agent.localise.co_moving import LEAST_SWEEPS, CoMoving
from gnd.vehicle_agent.localise.estimates import PoseEstimate, RefinedScan
from gnd.vehicle_agent.localise.localiser import Localiser
from gnd.vehicle_agent.localise.match_map import MatchMapCache
from gnd.vehicle_agent.localise.parameters import NOISE_M, RegistrationParameters
from gnd.vehicle_agent.localise.registration import settle
from gnd.vehicle_agent.localise.rolling_map import ROLLING_MOVE_M, RollingMap
from gnd.vehicle_agent.localise.stretch import (
    N_SHARED,
    Knot,
    StretchBelief,
    StretchStep,
    marginalised,
    solve_stretch,
)
from gnd.vehicle_agent.packed_rays import PackedRays, PlacedRays
from gnd.vehicle_agent.report.packing import pack, pack_measured
from gnd.vehicle_agent.report.reporter import on_lattice
from gnd.vehicle_agent.segment import MotionSegmenter, SegmentedScan

_LIDAR_HEIGHT_M = 2.0
_STEP_NS = 20_000_000
_SWEEP_NS = 100_000_000
_SEGMENTED = 10
_SEGMENT_STEP_NS = 300_000_000


def warm_up() -> None:
    """Run the whole way of a few scans on a small scene; starts no thread and opens nothing."""
    tile_id = TileId.from_geodetic(0.6555, 2.2173)
    frame = LocalFrame.of_tile(tile_id)
    points = _room()
    local_map = _map_of(points, GridFrame.around(frame, [tile_id]))
    detector = ChangeDetector(local_map)
    refined = _localised(local_map, points, frame)
    for scan in refined:
        detector.add_scan(scan.points_map_m, scan.origins_map_m)
    _try(local_map, refined)
    recent_map(points.astype(np.float32), NOISE_M, np.zeros(3), np.zeros(3), 50.0)  # only where a pose seems to jump
    _rolled(points)
    _stretched(local_map, points)
    _beside_others(points)
    MotionSignal.of(np.arange(3.0), np.zeros(3), np.zeros(3)).rates(np.ones(1))  # clocks are compared where one drives
    solve_chain(np.zeros(1), np.ones(2), np.zeros((2, 6)))
    _segment(points, refined[-1].estimate if refined else None)
    _find_poles(points)
    detector.add_scan(points, np.array([0.0, 0.0, _LIDAR_HEIGHT_M]))
    for evidence in detector.finish(local_map.tiles).values():
        _pack(tile_change(classify(evidence, detector.parameters)), evidence.base, points, frame)


def _pack(change: TileChange, base: Tile, points_map_m: F64, frame: LocalFrame) -> None:
    """Say in short that one voxel of a tile is as it was: the coders of flags, tiles, masks and Gaussians."""
    one, tile = base.gaussians.take([0]), base.tile_id
    kind, rays = np.array([ChangeClass.MODIFIED], np.uint8), np.zeros((1, 4), np.int32)
    said = on_lattice(replace(change, observed=one.voxel_id, changed=one, change_class=kind, evidence=rays))
    builder, bases = TrackBuilder(frame), {base.sha: base.gaussians}
    builder.add_scan(0, points_map_m, np.array([0.0, 0.0, _LIDAR_HEIGHT_M]), np.eye(4))
    report = ChangeReport(deterministic_report_id(0, "warm"), "warm", "", "", tile.district, 0, 0, (said,))
    pack(report, bases, builder.track(tile.district, [tile])).encode()
    pack_measured(report, bases, encode_mask(np.ones(1, np.bool_)))


def _try(local_map: LocalMap, scans: list[RefinedScan]) -> None:
    """Ask whether a shift explains what the scans see."""
    trial = Trial(MatchMapCache(local_map, RegistrationParameters().noise_m))
    for scan in scans:
        for _ in trial.push(SegmentedScan(scan, np.zeros(len(scan), np.bool_))):
            pass
    for _ in trial.flush():
        pass
    for scan in scans[:1]:
        PackedRays.of(*scan.rays.restore()).restore()


def _rolled(points_m: F64) -> None:
    """Scan-to-scan odometry of a vehicle that moves: its map rolls on only after some metres."""
    rolling = RollingMap(NOISE_M)
    for x_m in (0.0, 2.0 * ROLLING_MOVE_M):
        rolling.add(points_m, np.array([x_m, 0.0, 0.0]))


def _stretched(local_map: LocalMap, points_m: F64) -> None:
    """Solve a stretch, let go of its first scans, stand on wheels alone: no vehicle that stands comes so far."""
    knots = [Knot(points_m, np.eye(4), 1.0) for _ in range(3)]
    steps = [[StretchStep(np.eye(4), np.eye(6), np.zeros((6, N_SHARED)))]] * 2
    belief = StretchBelief(np.eye(4), np.zeros(N_SHARED), np.eye(6 + N_SHARED), np.zeros(6 + N_SHARED))
    match_map, registration = MatchMapCache(local_map, NOISE_M).near(np.zeros(3)), RegistrationParameters()
    solve_stretch(knots, steps, belief, match_map, registration, (2.0,))
    marginalised(knots, steps, belief, np.zeros(N_SHARED), registration)
    settle(np.eye(4), match_map)


def _beside_others(points_m: F64) -> None:
    """Look for what travels along with a vehicle that drives."""
    co_moving, forward = CoMoving(np.eye(4)), np.eye(4)
    forward[0, 3] = 1.0
    sweep, offset_ns = points_m.astype(np.float32), np.zeros(len(points_m), np.uint32)
    chosen = np.arange(0, len(points_m), 9)
    for number in range(LEAST_SWEEPS + 3):
        t_ns = number * _SWEEP_NS
        co_moving.see(sweep, offset_ns, t_ns, t_ns, chosen, points_m[chosen], forward)


def _find_poles(points_m: F64) -> None:
    """Look for poles where there are none: every kernel runs all the same."""
    PoleDetector().look(points_m, np.array([0.0, 0.0, _LIDAR_HEIGHT_M]))


def _segment(points_map_m: F64, estimate: PoseEstimate | None) -> None:
    """Segment a few scans of the room in which a box drives by."""
    segmenter = MotionSegmenter()
    sensor = np.array([0.0, 0.0, _LIDAR_HEIGHT_M])
    side = np.stack(np.meshgrid(np.arange(0.0, 3.0, 0.1), [3.0], np.arange(0.3, 1.6, 0.1)), axis=-1).reshape(-1, 3)
    for number in range(_SEGMENTED):
        t_ns = number * _SEGMENT_STEP_NS
        seen = np.concatenate([points_map_m, side + np.array([2.0 * number - 9.0, 0.0, 0.0])])
        pose = PoseEstimate(t_ns, np.eye(4) if estimate is None else estimate.T_map_vehicle, 0.01, 0.001, 1.0, "good")
        segmenter.push(RefinedScan(t_ns, PlacedRays(seen, np.broadcast_to(sensor, seen.shape).copy()), pose))
    for _ in segmenter.flush():
        pass


def _room() -> F64:
    """Points (N, 3) of a floor of 24 m x 16 m and two walls, map frame."""
    x, y = np.meshgrid(np.arange(-12.0, 12.0, 0.15), np.arange(-8.0, 8.0, 0.15))
    floor = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.05)], axis=1)
    along, up = np.meshgrid(np.arange(-12.0, 12.0, 0.15), np.arange(0.1, 4.0, 0.15))
    side = np.stack([along.ravel(), np.full(along.size, 7.9), up.ravel()], axis=1)
    end = np.stack([np.full(along.size, 11.9), along.ravel() * 0.6, up.ravel()], axis=1)
    return np.concatenate([floor, side, end])


def _map_of(points_map_m: F64, grid_frame: GridFrame) -> LocalMap:
    accumulator, local_map = VoxelAccumulator(grid_frame), LocalMap(grid_frame)
    accumulator.add(points_map_m)
    for tile_id, gaussians in accumulator.finish().items():
        local_map.set_tile(Tile(tile_id, 1, gaussians))
    return local_map


def _localised(local_map: LocalMap, points_map_m: F64, frame: LocalFrame) -> list[RefinedScan]:
    """What a standing vehicle makes of three scans of the room."""
    T_vehicle_lidar = np.eye(4)
    T_vehicle_lidar[2, 3] = _LIDAR_HEIGHT_M
    localiser = Localiser(local_map, T_vehicle_lidar)
    seen = np.ascontiguousarray(points_map_m - T_vehicle_lidar[:3, 3], dtype=np.float32)
    offset_ns = np.linspace(0, _SWEEP_NS - 1, len(seen)).astype(np.uint32)
    localiser.push_gnss(GnssFix(0, frame.lat_rad, frame.lon_rad, 0.0, 0.3))
    refined: list[RefinedScan] = []
    for number in range(3):
        for k in range(_SWEEP_NS // _STEP_NS):
            localiser.push_motion(MotionSample(number * _SWEEP_NS + k * _STEP_NS, 0.0, 0.0))
        refined += localiser.take_scan(Scan(number * _SWEEP_NS, seen, offset_ns))
    return [*refined, *localiser.flush()]
