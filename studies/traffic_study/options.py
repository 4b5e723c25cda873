"""What a traffic study runs: street, drives, sensor, poses."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from gnd.fleet_sim.sensors import SHORT_NAMES
from gnd.fleet_sim.street import StreetOptions
from studies.frame.errors import OptionError
from studies.frame.options import Option, check, option, parts
from studies.simulation.options import SET, Base, MethodParameters, PoseSource, RunOptions, method_of


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


def street_of(kind: str, length_m: float | None = None, edit_share: float | None = None) -> StreetOptions:
    """Return the street of a kind, with its own length and share of edits or others.

    Raises:
        OptionError: no such kind.
    """
    if kind not in STREETS:
        raise OptionError(f"unknown street {kind!r}, use one of {', '.join(STREETS)}")
    usual = STREETS[kind]
    share = usual.edit_share if edit_share is None else edit_share
    return StreetOptions(length_m or usual.length_m, "wangsimni", edit_share=share)


@dataclass(frozen=True, slots=True)
class TrafficOptions:
    """One traffic study. Vehicles that are on the street together know the map as it was before they began; after
    `f1_drives` the map is scored, once as it travelled and once in floats.
    """

    seed: int = option(201, "Seed of the world.", "--seed", "--world-seed")
    street: StreetOptions = parts(
        street_of,
        kind=("usual", Option("How much has changed: usual or rebuilt.", ("--street",))),
        length_m=(None, Option("Length of the street, metres.  [default: the street's]", ("--length",), of=float)),
        edit_share=(None, Option("Share of the street's edits made.  [default: the street's]", ("--edits",), of=float)),
    )
    parking: float = parts(
        lambda parking, kind="usual": STREETS[kind].parking if parking is None else parking,
        using=("kind",),
        parking=(None, Option("Share of parking slots that are taken.  [default: the street's]", of=float)),
    )
    drives: int = option(38, "How many vehicles drive, one after the other, as in the paper.", span=(1, 200))
    at_once: int = option(4, "So many are on the street at a time.", span=(1, 200))
    sensor: str = option("vlp16", "The sensor of all vehicles, as in the paper.", known=SHORT_NAMES)
    traffic: bool = option(True, "Moving cars and pedestrians.")
    poses: PoseSource = option(PoseSource(), "estimated, true, or noisy:<m>:<deg>.", read=PoseSource.parse)
    base: Base = option("driven", "How the map before was made.")
    pcd_drives: int = option(4, "The point-cloud baseline runs beside so many drives.", span=(0, None))
    f1_drives: int = option(4, "F1 after so many drives, also in floats; 0: not.", span=(0, None))
    scans: int | None = option(None, "At most so many scans a drive, for a quick look.", span=(1, None))
    method: MethodParameters = parts(method_of, changes=SET)

    def __post_init__(self) -> None:
        check(self)
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
