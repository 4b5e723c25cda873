"""One run of the localiser over a recorded drive, the map's tiles held around the vehicle as the agent does."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from gnd.gnd_map.motion import Trajectory
from gnd.schemas.drive import DriveHeader, DriveItem, GnssFix, ReferencePose, Scan
from gnd.vehicle_agent.config import PipelineParameters
from gnd.vehicle_agent.localise.estimates import PoseEstimate
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.pipeline import Pipeline
from gnd.vehicle_agent.sources.recording import first_fix
from gnd.vehicle_agent.tiles_at_hand import TilesAtHand
from studies.localisation_study.series import PoseSeries
from studies.localisation_study.variants import Variant
from studies.simulation.base_map import BaseMap


@dataclass(frozen=True, slots=True, eq=False)
class LocalisedVariant:
    """What a run gave: final and online poses against the truth, and how many scans it was given."""

    final: PoseSeries
    online: PoseSeries
    scans: int


class LocalisingVehicle:
    """A localiser over held tiles; gives its online pose after every scan.

    Attributes:
        scans: how many its sensor gave, usable or not.
        online: all online poses so far, those called lost left out.
    """

    def __init__(self, header: DriveHeader, fix: GnssFix, base: BaseMap, parameters: LocaliserParameters) -> None:
        self.pipeline = Pipeline(
            header,
            fix,
            lambda local_map, touched: TilesAtHand(base, local_map, touched),
            PipelineParameters(localise=parameters),
        )
        self.scans = 0
        self.online: list[PoseEstimate] = []
        self.T_map_anchor = self.pipeline.place.frame.T_self_other(header.anchor)
        self._final: list[PoseEstimate] = []
        self._newest_ns = -1

    def push(self, item: DriveItem) -> None:
        """Take a measurement."""
        output = self.pipeline.push(item)
        self._final += output.poses
        if output.online is not None and output.online.t_ns > self._newest_ns:
            self._newest_ns = output.online.t_ns
            self.online += [output.online] if output.online.health != "lost" else []

    def finish(self) -> list[PoseEstimate]:
        """End the drive and give all final poses."""
        self._final += self.pipeline.finish().poses
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
) -> LocalisedVariant:
    """Run the localiser over a drive.

    Args:
        header: of the drive.
        items: in time order, with reference poses, which the vehicle never sees.
        base: the map that it drives on.
        parameters: of the localiser.
        variant: what is done to the measurements.

    Raises:
        VehicleError: the drive has no GNSS fix.
    """
    fix, all_items = first_fix(items, header.drive_id)
    vehicle = LocalisingVehicle(variant.header(header), fix, base, parameters)
    reference: list[ReferencePose] = []
    for item in _changed(all_items, variant, vehicle):
        if isinstance(item, ReferencePose):
            reference.append(item)
        else:
            vehicle.push(item)
    final, true = vehicle.finish(), vehicle.reference(reference)
    return LocalisedVariant(PoseSeries.of(final, true), PoseSeries.of(vehicle.online, true), vehicle.scans)


def _changed(items: Iterable[DriveItem], variant: Variant, vehicle: LocalisingVehicle) -> Iterator[DriveItem]:
    for item in items:
        vehicle.scans += isinstance(item, Scan)
        variant.posed = bool(vehicle.online)
        yield from variant.items(item)


def without_submaps(parameters: LocaliserParameters) -> LocaliserParameters:
    """Return the parameters of the general graph SLAM: final poses are those that leave the pose graph."""
    return replace(parameters, refine=replace(parameters.refine, enabled=False))
