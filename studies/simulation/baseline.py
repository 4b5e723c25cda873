"""The point-cloud baseline beside: the same scans, poses and movers, another map and upload (GND, section 7.4)."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from gnd.fleet_sim.evaluate import Evaluation
from gnd.fleet_sim.truth import Truth, grid_of
from gnd.fleet_sim.world import World
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.se3 import transform
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.segment import SegmentedScan
from studies.frame.errors import FolderError
from studies.frame.kept import read_npz, write_npz
from studies.pcd import PcdDetector, PcdMap, PcdReport, base_pcd, evaluate_gnd, gnd_of, merge_pcd


def write_cloud(world: World, path: Path) -> None:
    """Make the baseline's map of the state before and write it; the file appears complete or not at all."""
    keep_cloud(base_pcd(world), path)


def keep_cloud(cloud: PcdMap, path: Path) -> None:
    """Write a cloud; the file appears complete or not at all."""
    frame = cloud.frame
    anchor = np.array([frame.lat_rad, frame.lon_rad, frame.height_m])
    write_npz(path, {"points_m": cloud.points_m, "anchor": anchor}, compressed=False)


def read_cloud(path: Path) -> PcdMap:
    """Read the baseline's map.

    Raises:
        FolderError: it is missing or damaged.
    """
    data = read_npz(path)
    try:
        return PcdMap(data["points_m"], LocalFrame(*data["anchor"].tolist()))
    except (ValueError, KeyError) as error:
        raise FolderError(f"cannot read the point cloud {path}: {error}") from error


class CloudVehicle:
    """The baseline's vehicle: sees what the detector sees."""

    def __init__(self, base: PcdMap, map_frame: LocalFrame) -> None:
        self._base = base
        self._detector = PcdDetector(base)
        self._T_cloud_map = base.frame.T_self_other(map_frame)

    def add_scan(self, segmented: SegmentedScan) -> None:
        """Count the rays of a scan, given in the vehicle's map frame."""
        scan, T = segmented.scan, self._T_cloud_map
        points, origins = transform(T, scan.points_map_m), transform(T, scan.origins_map_m)
        self._detector.add_scan(points, origins, segmented.moving)

    def report(self) -> tuple[PcdReport, Mapping[str, int]]:
        """Return what is uploaded, and its size in each of the baseline's codecs; "points" is the paper's."""
        found = self._detector.finish()
        return found, found.sizes(self._base)


class Clouds:
    """The baseline's cloud and its scores."""

    def __init__(self, truth: Truth, base: PcdMap) -> None:
        self._truth, self._base = truth, base
        self._before = self._gaussians(base)

    def score(self, reports: list[PcdReport]) -> Evaluation:
        """Return the score of the map that the baseline makes of these uploads."""
        return evaluate_gnd(self._truth, self._before, self._gaussians(merge_pcd(self._base, reports)))

    def _gaussians(self, cloud: PcdMap) -> dict[TileId, Gaussians]:
        return gnd_of(cloud, grid_of(self._truth))
