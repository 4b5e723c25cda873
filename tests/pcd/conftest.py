"""One small street, its point cloud, and the reports of three drives through it."""

import pytest
from pcd_world import PLAN, box_world, scans

from gnd.fleet_sim.world import World
from studies.pcd import PcdDetector, PcdMap, PcdReport, base_pcd


@pytest.fixture(scope="session")
def boxes() -> World:
    return box_world()


@pytest.fixture(scope="session")
def cloud(boxes: World) -> PcdMap:
    return base_pcd(boxes, PLAN)


@pytest.fixture(scope="session")
def reports(boxes: World, cloud: PcdMap) -> list[PcdReport]:
    found = []
    for seed in range(3):
        detector = PcdDetector(cloud)
        for points, origins in scans(boxes, seed):
            detector.add_scan(points, origins)
        found.append(detector.finish())
    return found
