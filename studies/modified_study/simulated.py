"""Rows of simulated worlds: the same scans for our detector and for the point-cloud baseline."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.drives import DriveConfig, DriveSimulation
from gnd.fleet_sim.evaluate import voxel_rows
from gnd.fleet_sim.sensing import Beams, Weather
from gnd.fleet_sim.sensors import SHORT_NAMES
from gnd.fleet_sim.street import StreetOptions, street
from gnd.fleet_sim.traffic import Traffic
from gnd.fleet_sim.truth import LEVELS, Truth, grid_of, make_truth
from gnd.fleet_sim.world import World
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.detect.classify import shape_candidates
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.detect.evidence import TileEvidence
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.segment.parameters import SegmentParameters
from studies.frame.scans import local_map_of
from studies.modified_study.rows import Method, ShapeRows, numbered
from studies.pcd import PcdMap, base_pcd
from studies.pcd.shapes import ChangedShapes, changed_shapes
from studies.real.drive import segmented
from studies.simulation.baseline import CloudVehicle
from studies.simulation.options import PoseSource
from studies.simulation.poses import FromReference

LENGTH_M = 100.0
"""The shortest street: rows come from many short worlds, not from one long one."""


@dataclass(frozen=True, slots=True)
class DriveSpec:
    """One drive through a world.

    Attributes:
        sensor: short name.
        parking: share of the slots that are taken; None: as usual in the family.
        weather, beams: as of `DriveConfig`.
    """

    sensor: str
    parking: float | None = None
    weather: Weather = "clear"
    beams: Beams = "ideal"


@dataclass(frozen=True, slots=True)
class WorldSpec:
    """A world and the drives through it; the point-cloud baseline, which takes longest, sees the first ones only."""

    family: str
    seed: int
    drives: tuple[DriveSpec, ...]
    cloud_drives: int = 1

    @property
    def name(self) -> str:
        """Such as "avenue 301"."""
        return f"{self.family} {self.seed}"


@dataclass(frozen=True, slots=True, eq=False)
class WorldRows:
    """The rows of a world's drives, in their order; the baseline has fewer (`WorldSpec.cloud_drives`)."""

    gnd: tuple[ShapeRows, ...]
    cloud: tuple[ShapeRows, ...]

    def of(self, method: Method) -> tuple[ShapeRows, ...]:
        """Those of a method."""
        return self.gnd if method == "gnd" else self.cloud


def rows_of_world(spec: WorldSpec) -> WorldRows:
    """Drive through a world with every sensor named; both methods see the same scans."""
    world = street(spec.seed, StreetOptions(LENGTH_M, family=spec.family))
    truth, cloud = make_truth(world), base_pcd(world) if spec.cloud_drives else None
    found = [
        _rows_of_drive(world, truth, cloud if i < spec.cloud_drives else None, config_of(spec, i))
        for i in range(len(spec.drives))
    ]
    return WorldRows(tuple(gnd for gnd, _ in found), tuple(cloud for _, cloud in found if cloud is not None))


def config_of(spec: WorldSpec, index: int) -> DriveConfig:
    """The drive of a number; directions alternate."""
    drive = spec.drives[index]
    return DriveConfig(
        vehicle=f"vehicle-{index:02d}",
        sensor=SHORT_NAMES[drive.sensor],
        direction=1 if index % 2 == 0 else -1,
        seed=1_000_003 * spec.seed + index,
        car_share=drive.parking,
        traffic=Traffic.urban(),
        weather=drive.weather,
        beams=drive.beams,
    )


def _rows_of_drive(
    world: World, truth: Truth, cloud: PcdMap | None, config: DriveConfig
) -> tuple[ShapeRows, ShapeRows | None]:
    """Rows of our detector and of the baseline: movers are marked, poses are off by 4 cm and 0.08 degrees."""
    simulation = DriveSimulation(world, config)
    local_map = local_map_of(GridFrame.around(world.frame, sorted(truth.before)), truth.before)
    detector = ChangeDetector(local_map)
    vehicle = None if cloud is None else CloudVehicle(cloud, local_map.grid_frame.frame)
    poses = FromReference(simulation.header(), local_map, PoseSource(), config.seed)
    refined = (scan for item in simulation.items() for scan in poses.push(item))
    for one in segmented(refined, SegmentParameters()):
        detector.add_scan(one.scan.points_map_m, one.scan.origins_map_m, one.moving)
        if vehicle is not None:
            vehicle.add_scan(one)
    rows = _rows_of_evidence(truth, detector.finish(local_map.tiles).values())
    if cloud is None or vehicle is None:
        return rows, None
    return rows, _rows_of_cloud(truth, changed_shapes(cloud, vehicle.report()[0], grid_of(truth)))


def _rows_of_evidence(truth: Truth, evidence: Iterable[TileEvidence]) -> ShapeRows:
    parts, at = [], []
    for e in evidence:
        rows = shape_candidates(e, DetectParameters())
        rays = np.stack([e.n_bi, e.n_bo, e.n_pi, e.n_po], axis=1)[rows]
        parts.append((e.base.gaussians.take(e.map_row[rows]), e.measured.take(rows), rays))
        at.append(voxel_rows(truth, e.base.tile_id, e.voxel_id[rows]))
    return _beside_truth(truth, parts, at)


def _rows_of_cloud(truth: Truth, shapes: Mapping[TileId, ChangedShapes]) -> ShapeRows:
    parts, at = [], []
    for tile, found in shapes.items():
        rays = np.stack([found.stayed, found.came, found.went, np.zeros_like(found.went)], axis=1)
        parts.append((found.was, found.now, rays))
        at.append(voxel_rows(truth, tile, found.was.voxel_id))
    return _beside_truth(truth, parts, at)


def _beside_truth(
    truth: Truth, parts: list[tuple[Gaussians, Gaussians, NDArray[np.int32]]], at: list[NDArray[np.int64]]
) -> ShapeRows:
    """Rows of the voxels that the truth knows, from what was measured by tile and where it stands in the truth."""
    was, now, rays = zip(*parts, strict=True)
    of_truth = np.concatenate(at)
    known = np.flatnonzero(of_truth >= 0)
    rows = of_truth[known]
    modified = truth.change_class == ChangeClass.MODIFIED
    lost = modified.copy()
    lost[rows] = False
    return ShapeRows(
        was=numbered([numbered(was).take(known)]),
        now=numbered([numbered(now).take(known)]),
        rays=np.concatenate(rays).astype(np.int32)[known],
        modified=modified[rows],
        held=np.isin(truth.change_class[rows], (ChangeClass.NORMAL, ChangeClass.MODIFIED)),
        observable=truth.observable[rows],
        scored=truth.mask("scored")[rows],
        missed=np.array([int((lost & truth.mask(level)).sum()) for level in LEVELS], np.int64),
    )
