"""One run of the localiser over a recorded drive, the map's tiles held around the vehicle as the agent does."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import DriveHeader, DriveItem, GnssFix, ReferencePose, Scan
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.estimates import PoseEstimate
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.place import Place
from gnd.vehicle_agent.scans import Guard
from studies.localisation_study.series import PoseSeries
from studies.localisation_study.variants import Variant
from studies.simulation.base_map import BaseMap
from studies.simulation.held_tiles import HeldTiles
from studies.simulation.poses import Localising
from studies.simulation.streams import first_fix


@dataclass(frozen=True, slots=True, eq=False)
class Localised:
    """What a run gave: final and online poses against the truth, and how many scans it was given."""

    final: PoseSeries
    online: PoseSeries
    scans: int


class Vehicle:
    """A localiser over held tiles; gives its online pose after every scan.

    Attributes:
        scans: how many its sensor gave, usable or not.
        online: all online poses so far, those called lost left out.
    """

    def __init__(self, header: DriveHeader, fix: GnssFix, base: BaseMap, parameters: LocaliserParameters) -> None:
        start = TileId.from_geodetic(fix.lat_rad, fix.lon_rad)
        frame = LocalFrame.of_tile(start)
        local_map = LocalMap(GridFrame.around(frame, [start]))
        self.scans = 0
        self.online: list[PoseEstimate] = []
        self.T_map_anchor = frame.T_self_other(header.anchor)
        self._held = HeldTiles(base, local_map, None)
        self._place = Place(frame, fix)
        self._localiser = Localising(header, local_map, parameters)
        self._final: list[PoseEstimate] = []
        self._newest_ns = -1

    def push(self, item: DriveItem) -> None:
        """Take a measurement."""
        if isinstance(item, Scan):
            self._held.follow(self._place)
        self._final += [refined.estimate for refined in self._localiser.push(item)]
        online = self._localiser.online
        if online is not None and online.t_ns > self._newest_ns:
            self._newest_ns = online.t_ns
            self.online += [online] if online.health != "lost" else []
        self._place.take(item, online)

    def finish(self) -> list[PoseEstimate]:
        """End the drive and give all final poses."""
        self._final += [refined.estimate for refined in self._localiser.flush()]
        return self._final

    def reference(self, poses: Iterable[ReferencePose]) -> Trajectory:
        """Return true poses in this vehicle's map frame."""
        known = list(poses)
        T = self.T_map_anchor @ np.stack([pose.T_map_vehicle for pose in known])
        return Trajectory(np.array([pose.t_ns for pose in known], np.int64), T)


def localise(
    header: DriveHeader,
    items: Iterable[DriveItem],
    base: BaseMap,
    parameters: LocaliserParameters,
    variant: Variant,
) -> Localised:
    """Run the localiser over a drive.

    Args:
        header: of the drive.
        items: in time order, with reference poses, which the vehicle never sees.
        base: the map that it drives on.
        parameters: of the localiser.
        variant: what is done to the measurements.

    Raises:
        ReproduceError: the drive has no GNSS fix.
    """
    fix, all_items = first_fix(iter(items))
    vehicle = Vehicle(variant.header(header), fix, base, parameters)
    reference: list[ReferencePose] = []
    guard = Guard()
    for item in guard.usable(_changed(all_items, variant, vehicle)):
        if isinstance(item, ReferencePose):
            reference.append(item)
        else:
            vehicle.push(item)
    final, true = vehicle.finish(), vehicle.reference(reference)
    return Localised(PoseSeries.of(final, true), PoseSeries.of(vehicle.online, true), vehicle.scans)


def _changed(items: Iterable[DriveItem], variant: Variant, vehicle: Vehicle) -> Iterator[DriveItem]:
    for item in items:
        vehicle.scans += isinstance(item, Scan)
        variant.posed = bool(vehicle.online)
        yield from variant.items(item)


def without_submaps(parameters: LocaliserParameters) -> LocaliserParameters:
    """Return the parameters of the general graph SLAM: final poses are those that leave the pose graph."""
    return replace(parameters, refine=replace(parameters.refine, enabled=False))
