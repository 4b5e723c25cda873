"""One vehicle on the cut street, from measurements to the parts of its surveys."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from gnd.fleet_sim.drives import DriveConfig, DriveSimulation
from gnd.fleet_sim.world import read_world
from gnd.gnd_map.arrays import F64, I64
from gnd.schemas.drive import ReferencePose
from gnd.vehicle_agent.pipeline import Pipeline
from gnd.vehicle_agent.report.reporter import Identity
from gnd.vehicle_agent.report.sink import ReportList
from gnd.vehicle_agent.sources.recording import first_fix
from gnd.vehicle_agent.tiles_at_hand import TilesAtHand
from studies.frame.kept import Kept
from studies.frame.pool import Tick
from studies.simulation.base_map import read_base
from studies.simulation.streams import as_recorded, ticking

SOFTWARE: Final = "gnd reproduce new-road"


@dataclass(frozen=True, slots=True)
class RoadTask:
    """One drive: files of world and cut map, what is simulated, where the result goes."""

    world: Path
    base: Path
    drive: DriveConfig
    kept: Kept


@dataclass(frozen=True, slots=True, eq=False)
class DrivenRoad:
    """What a drive gave.

    Attributes:
        vehicle, sensor: who.
        keys, bodies: of the parts of surveys, as they go to the cloud.
        t_ns, T_map_vehicle: true poses in the world's map frame.
        counts: of the surveyor.
        way_m: of the drive.
    """

    vehicle: str
    sensor: str
    keys: tuple[str, ...]
    bodies: tuple[bytes, ...]
    t_ns: I64
    T_map_vehicle: F64
    counts: dict[str, int]
    way_m: float


def drive_road(task: RoadTask, tick: Tick) -> None:
    """Simulate a drive and run the vehicle over it."""
    world, base = read_world(task.world), read_base(task.base)
    simulation = DriveSimulation(world, replace(task.drive, camera=None))
    header, outbox, reference = simulation.header(), ReportList(), list[ReferencePose]()
    fix, items = first_fix(ticking(map(as_recorded, simulation.items()), tick, simulation.scans), header.drive_id)
    identity = Identity(header.vehicle, header.drive_id, header.sensor_model, "ndt", SOFTWARE)
    pipeline = Pipeline(
        header, fix, lambda local, touched: TilesAtHand(base, local, touched), identity=identity, outbox=outbox
    )
    for item in items:
        if isinstance(item, ReferencePose):
            reference.append(item)
        pipeline.push(item)
    pipeline.finish()
    surveys = [one for one in outbox.reports if is_survey(one.body)]
    T_map_anchor = world.frame.T_self_other(header.anchor)
    account: dict[str, Any] = {} if pipeline.surveyor is None else pipeline.surveyor.account()
    task.kept.write(
        DrivenRoad(
            header.vehicle,
            header.sensor_model,
            tuple(one.key for one in surveys),
            tuple(one.body for one in surveys),
            np.array([one.t_ns for one in reference], np.int64),
            T_map_anchor @ np.stack([one.T_map_vehicle for one in reference]),
            {name: int(value) for name, value in account.items()},
            float(pipeline.place.odometer_m),
        )
    )


def is_survey(body: bytes) -> bool:
    """Whether a report is a part of a survey."""
    from gnd.schemas.packed import decode_upload
    from gnd.schemas.survey import SurveyReport

    return isinstance(decode_upload(body), SurveyReport)
