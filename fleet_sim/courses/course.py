"""What a drive of the hard cases consists of: the ground and what stands on it, the lane, the company, the faults."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from gnd.fleet_sim.courses.company import Companion
from gnd.fleet_sim.courses.faults import Faults
from gnd.fleet_sim.courses.foliage import Leaves
from gnd.fleet_sim.courses.path import Path
from gnd.fleet_sim.courses.ride import Ride
from gnd.fleet_sim.courses.terrain import TerrainGround
from gnd.fleet_sim.shapes import Shape
from gnd.fleet_sim.world import State, World


@dataclass(frozen=True, eq=False)
class CoursePlace:
    """Where drives go: made from a seed, the same for all cases that use it.

    Attributes:
        name: of the kind of place; places of one name and seed have the same state before, and so the same map.
        world: what stands there in both states, opaque things.
        ground: what vehicles drive on.
        lane: that is driven, from end to end of what was mapped.
        surveys: that the mapping vehicle drives.
        foliage: leaves of either state.
        mapped_behind: vehicles that kept pace with the mapping vehicle and are in its scans.
    """

    name: str
    world: World
    ground: TerrainGround
    lane: Path
    surveys: tuple[Path, ...]
    foliage: Mapping[State, tuple[Leaves, ...]] = field(default_factory=dict)
    mapped_behind: tuple[Companion, ...] = ()


@dataclass(frozen=True, eq=False)
class DrivenCourse:
    """One drive through a place in its state after.

    Attributes:
        place: where.
        ride: how fast.
        company: other vehicles on the road.
        faults: of the sensors.
        parked: cars at the kerb of this drive, street frame.
    """

    place: CoursePlace
    ride: Ride
    company: tuple[Companion, ...] = ()
    faults: Faults = field(default_factory=Faults)
    parked: tuple[Shape, ...] = ()
