"""What a reproduction runs: worlds, fleet, poses, method. Everything that decides its numbers, and nothing else."""

from dataclasses import dataclass, field
from typing import Literal

from gnd.fleet_sim.sensors import SHORT_NAMES
from gnd.fleet_sim.street import StreetOptions
from studies.simulation.errors import OptionError
from studies.simulation.method import MethodParameters, Mode
from studies.simulation.pose_source import PoseSource

Base = Literal["surveyed", "driven"]
Upload = Literal["float", "full", "packed"]

_MOST_VEHICLES = 200


@dataclass(frozen=True, slots=True)
class RunOptions:
    """One reproduction.

    Attributes:
        seeds: world seeds; the numbers are given for each, and their mean.
        street: length and place.
        vehicles: numbers of vehicles whose merged map is scored.
        sensors: short names; the fleet cycles through them.
        parking: share of parking slots that are taken.
        traffic: whether other cars and pedestrians move about.
        mode: whose rules; `method` holds them in full.
        poses: where the poses come from.
        base: "surveyed": the map before is the truth's own; "driven": it is built from mapping drives.
        method: all parameters of the method.
        scans: at most so many scans a drive, None for the whole street.
        pcd: whether the point-cloud baseline runs beside.
        upload: how reports travel: "float": whole, with Gaussians as measured; "full": whole, with Gaussians on their
            lattice; "packed": in short, flags first, as agents send them.
    """

    seeds: tuple[int, ...] = (201,)
    street: StreetOptions = field(default_factory=lambda: StreetOptions(400.0, "wangsimni"))
    vehicles: tuple[int, ...] = (1, 5, 9, 20)
    sensors: tuple[str, ...] = tuple(SHORT_NAMES)
    parking: float = 0.2
    traffic: bool = True
    mode: Mode = "default"
    poses: PoseSource = field(default_factory=PoseSource)
    base: Base = "surveyed"
    method: MethodParameters = field(default_factory=MethodParameters)
    scans: int | None = None
    pcd: bool = True
    upload: Upload = "full"

    def __post_init__(self) -> None:
        if not self.seeds or min(self.seeds) < 0 or len(set(self.seeds)) != len(self.seeds):
            raise OptionError(f"world seeds must be different integers >= 0, got {_listed(self.seeds)}")
        if not self.vehicles or not 1 <= min(self.vehicles) <= max(self.vehicles) <= _MOST_VEHICLES:
            raise OptionError(f"numbers of vehicles must lie in 1 … {_MOST_VEHICLES}, got {_listed(self.vehicles)}")
        unknown = [name for name in self.sensors if name not in SHORT_NAMES]
        if unknown or not self.sensors:
            raise OptionError(f"unknown sensor {_listed(unknown) or '(none)'}; known are {', '.join(SHORT_NAMES)}")
        if not 0.0 <= self.parking <= 1.0:
            raise OptionError(f"the share of parking slots taken must lie in 0 … 1, got {self.parking:g}")
        if self.scans is not None and self.scans < 1:
            raise OptionError(f"a drive needs at least one scan, got {self.scans}")

    @property
    def fleet_size(self) -> int:
        """How many vehicles drive: the largest fleet, and every sensor at least once."""
        return max(*self.vehicles, len(self.sensors))


def _listed(values: "list[str] | tuple[int, ...]") -> str:
    return ", ".join(map(str, values))
