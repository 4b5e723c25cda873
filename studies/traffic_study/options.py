"""What a traffic study runs: street, drives, sensor, poses."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final

from gnd.fleet_sim.sensors import SHORT_NAMES
from gnd.fleet_sim.street import StreetOptions
from studies.simulation.errors import OptionError
from studies.simulation.method import MethodParameters
from studies.simulation.options import Base, RunOptions
from studies.simulation.pose_source import PoseSource

_MOST_DRIVES = 200


@dataclass(frozen=True, slots=True)
class StreetKind:
    """How much has changed on a street, and what stands in the way.

    Attributes:
        length_m: stretch that is driven.
        edit_share: share of the street's edits that are made.
        parking: share of parking slots that are taken on each drive.
    """

    length_m: float
    edit_share: float
    parking: float


STREETS: Final[Mapping[str, StreetKind]] = MappingProxyType(
    {"usual": StreetKind(800.0, 0.04, 0.05), "rebuilt": StreetKind(400.0, 1.0, 0.2)}
)
"""usual: a drive reports about as many changes a km as the GND paper's uploads hold (docs/traffic.md); rebuilt: a fifth
of the street has changed, as for the scores of change detection."""


@dataclass(frozen=True, slots=True)
class TrafficOptions:
    """One traffic study.

    Attributes:
        seed: of the world.
        street: its length, place, and share of edits.
        parking: share of parking slots that are taken on each drive.
        drives: how many vehicles drive, one after the other.
        at_once: so many are on the street at a time: they know the map as it was before they began.
        sensor: short name; all drives have the same, as in the paper.
        traffic: whether other cars and pedestrians move about.
        poses: where the poses come from.
        base: how the map before was made; see `studies.simulation.options`.
        pcd_drives: the point-cloud baseline runs beside the first so many drives.
        f1_drives: after so many drives the map is scored, once as it travelled and once in floats; 0: not at all.
        scans: at most so many scans a drive, None for the whole street.
        method: all parameters of vehicle and merge.
    """

    seed: int = 201
    street: StreetOptions = field(default_factory=lambda: street_options("usual"))
    parking: float = STREETS["usual"].parking
    drives: int = 38
    at_once: int = 4
    sensor: str = "vlp16"
    traffic: bool = True
    poses: PoseSource = field(default_factory=PoseSource)
    base: Base = "driven"
    pcd_drives: int = 4
    f1_drives: int = 4
    scans: int | None = None
    method: MethodParameters = field(default_factory=MethodParameters)

    def __post_init__(self) -> None:
        if not 1 <= self.drives <= _MOST_DRIVES or not 1 <= self.at_once <= _MOST_DRIVES:
            raise OptionError(f"1 … {_MOST_DRIVES} drives, some at a time; got {self.drives}, {self.at_once} at a time")
        if not min(self.pcd_drives, self.f1_drives) >= 0:
            raise OptionError(f"numbers of drives must not be negative, got {self.pcd_drives} and {self.f1_drives}")
        _ = self.world  # which checks the rest

    @property
    def world(self) -> RunOptions:
        """What `studies.simulation.worlds` needs to know."""
        return RunOptions(
            seeds=(self.seed,),
            street=self.street,
            vehicles=(1,),
            sensors=(self.sensor,),
            parking=self.parking,
            traffic=self.traffic,
            poses=self.poses,
            base=self.base,
            method=self.method,
            scans=self.scans,
        )

    @property
    def sensor_model(self) -> str:
        """Name of the sensor in recordings."""
        return SHORT_NAMES[self.sensor]


def street_options(kind: str, length_m: float | None = None) -> StreetOptions:
    """Return the street of a kind, of its own length or another.

    Raises:
        OptionError: no such kind.
    """
    found = street_kind(kind)
    return StreetOptions(length_m or found.length_m, "wangsimni", edit_share=found.edit_share)


def street_kind(name: str) -> StreetKind:
    """Return a kind of street by its name.

    Raises:
        OptionError: there is none.
    """
    if name not in STREETS:
        raise OptionError(f"unknown street {name!r}, use one of {', '.join(STREETS)}")
    return STREETS[name]
