"""What a reproduction runs: worlds, fleet, poses, method. Everything that decides its numbers, and nothing else."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from math import degrees, radians
from typing import Any, Final, Literal

import numpy as np

from gnd.cloud_merger.confirmation import ConfirmationParameters
from gnd.cloud_merger.merge import MergeParameters
from gnd.fleet_sim.cars import MAX_STAY_H
from gnd.fleet_sim.drives import EPOCH_NS, DriveConfig
from gnd.fleet_sim.families.names import FAMILY_NAMES
from gnd.fleet_sim.sensing import Beams, Weather
from gnd.fleet_sim.sensors import SHORT_NAMES
from gnd.fleet_sim.street import StreetOptions
from gnd.fleet_sim.traffic import Traffic
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.settings import changed, setting
from gnd.vehicle_agent.config import ReportParameters
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.segment.parameters import SegmentParameters
from studies.frame.errors import OptionError
from studies.frame.options import Option, check, numbers, option, parts, seeds

Kind = Literal["true", "noisy", "estimated"]

_METRES: Final = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_RADIANS: Final = {"deg": radians(1.0), "mrad": 1e-3, "rad": 1.0}
_NUMBER: Final = r"(\d+\.?\d*|\.\d+)(?:[eE]-?\d+)?"
_NOISY: Final = re.compile(rf"noisy:(?P<m>{_NUMBER})(?P<m_unit>mm|cm|m):(?P<rad>{_NUMBER})(?P<rad_unit>deg|mrad|rad)")
_MAX_SIGMA_M: Final = 1.0
_MAX_SIGMA_RAD: Final = radians(5.0)


@dataclass(frozen=True, slots=True)
class PoseSource:
    """How the poses of a drive are made.

    Attributes:
        kind: "true": the reference poses; "noisy": the same with an error; "estimated": the vehicle's own localiser.
        sigma_m: standard deviation on each horizontal axis.
        sigma_rad: of the heading.
    """

    kind: Kind = "noisy"
    sigma_m: float = 0.04
    sigma_rad: float = radians(0.08)

    def __post_init__(self) -> None:
        if not 0.0 <= self.sigma_m <= _MAX_SIGMA_M or not 0.0 <= self.sigma_rad <= _MAX_SIGMA_RAD:
            raise OptionError(
                f"poses may be off by at most {_MAX_SIGMA_M:g} m and {degrees(_MAX_SIGMA_RAD):g} deg,"
                f" got {self.sigma_m:g} m and {degrees(self.sigma_rad):g} deg"
            )

    @classmethod
    def parse(cls, text: str) -> "PoseSource":
        """Read `true`, `estimated` or `noisy:<length><mm|cm|m>:<angle><deg|mrad|rad>`.

        Raises:
            OptionError: it is none of these.
        """
        if text in ("true", "estimated"):
            return cls("true" if text == "true" else "estimated", 0.0, 0.0)
        found = _NOISY.fullmatch(text)
        if found is None:
            raise OptionError(f"poses are true, estimated or such as noisy:4cm:0.08deg, got {text!r}")
        return cls(
            "noisy", float(found["m"]) * _METRES[found["m_unit"]], float(found["rad"]) * _RADIANS[found["rad_unit"]]
        )

    @classmethod
    def several(cls, text: str) -> "tuple[PoseSource, ...]":
        """Read pose sources with commas between; the first is what the others are compared with.

        Raises:
            OptionError: one of them cannot be read, or comes twice.
        """
        found = tuple(cls.parse(part.strip()) for part in text.split(","))
        if len(set(found)) != len(found):
            raise OptionError(f"--poses {text}: each source of poses once")
        return found

    def __str__(self) -> str:
        if self.kind != "noisy":
            return self.kind
        return f"noisy:{self.sigma_m * 100:.10g}cm:{degrees(self.sigma_rad):.10g}deg"


Mode = Literal["default", "paper", "paper-observers"]
"""Whose rules; of the paper's, ξ as printed or with the observers as denominator (`gnd.cloud_merger.statements`)."""
SET: Final = ((), Option("Replace a parameter, GROUP.FIELD=VALUE.", ("--set",), repeated=True))
"""The option `--set`, for `studies.frame.options.parts`."""


@dataclass(frozen=True, slots=True)
class MethodParameters:
    """Everything that decides what vehicles report and what the cloud makes of it."""

    localise: LocaliserParameters = setting(LocaliserParameters, "Localisation.")
    segment: SegmentParameters = setting(SegmentParameters, "Segmentation.")
    detect: DetectParameters = setting(DetectParameters, "Detection.")
    report: ReportParameters = setting(ReportParameters, "Reports.")
    merge: MergeParameters = setting(MergeParameters, "The merge.")
    confirmation: ConfirmationParameters = setting(ConfirmationParameters, "Of it `parked_h` alone.")

    @property
    def parked_h(self) -> float:
        """How long what has the shape of a vehicle must have stood; 0 in paper mode, which does not know it."""
        return self.confirmation.parked_h if self.merge.mode == "default" else 0.0

    @classmethod
    def of_mode(cls, mode: Mode) -> "MethodParameters":
        """Return the parameters of a mode; movers are segmented in both, as in the paper ([50])."""
        if mode == "default":
            return cls()
        return cls(detect=DetectParameters.paper(), merge=MergeParameters(mode=mode, eps=0.5))

    def with_changes(self, changes: Iterable[str]) -> "MethodParameters":
        """Return these parameters with fields replaced.

        Args:
            changes: such as "detect.new_cells=30" or "detect.masses.lambda_c_pass=0.04"; values as in JSON, words
                without quotes.

        Raises:
            OptionError: no such field, or a value that it refuses.
        """
        try:
            return changed(self, list(changes))
        except GndError as error:
            raise OptionError(str(error)) from error


def method_of(changes: Iterable[str], mode: Mode = "default") -> MethodParameters:
    """Return the parameters of a mode with fields replaced."""
    return MethodParameters.of_mode(mode).with_changes(changes)


Base = Literal["surveyed", "driven"]
Upload = Literal["float", "full", "packed"]


def street_option(length_m: float) -> Any:
    """The options of a street: its length and place."""
    return parts(
        StreetOptions,
        length_m=(length_m, Option("Length of the street, metres.", ("--length",))),
        site=("wangsimni", Option("Where it lies: wangsimni, border or north49.")),
        family=("street", Option(f"Kind of place: {', '.join(FAMILY_NAMES)}.")),
    )


def sensors_option(default: tuple[str, ...], text: str) -> Any:
    """The option of sensors, by their short names."""
    return option(default, text, known=SHORT_NAMES)


PARKING: Final = "Share of parking slots that are taken; by default the usual one of the family, mostly 0.2."


@dataclass(frozen=True, slots=True)
class RunOptions:
    """One reproduction; of several seeds the numbers are given for each, and their mean."""

    seeds: tuple[int, ...] = seeds(201, text="Seeds of the world, such as 1,2,5-9.")
    street: StreetOptions = street_option(400.0)
    vehicles: tuple[int, ...] = option(
        (1, 5, 9, 20),
        "Sizes of the fleet that are reported.",
        span=(1, 200),
        read=lambda text: tuple(sorted(set(numbers("--vehicles", text)))),
    )
    sensors: tuple[str, ...] = sensors_option(tuple(SHORT_NAMES), "Sensors that the fleet cycles through.")
    parking: float | None = option(None, PARKING, span=(0, 1))
    traffic: bool = option(True, "Moving cars and pedestrians.")
    weather: Weather = option("clear", "Weather of the drives after the changes.")
    beams: Beams = option("ideal", "Beams of the LiDARs; real ones have a width: mixed pixels, bias, blooming signs.")
    apart_min: float = option(60.0, "Minutes between the starts of two vehicles.", "--apart", span=(0, 1e5))
    stay_h: float = option(
        0.0, "Mean stay of a parked car in hours; 0: every drive meets others.", "--stay", span=(0, MAX_STAY_H)
    )
    mode: Mode = option("default", "Whose rules; paper: ξ as printed, paper-observers: observers as its denominator.")
    poses: PoseSource = option(
        PoseSource(), "estimated, true, or noisy:<m>:<deg>; true,estimated compares.",
        read=lambda text: PoseSource.several(text)[0],
    )  # fmt: skip
    base: Base = option("surveyed", "The map before: the truth's own, or built from mapping drives.")
    method: MethodParameters = parts(method_of, using=("mode",), changes=SET)
    scans: int | None = option(None, "At most so many scans a drive, for a quick look.", span=(1, None))
    pcd: bool = option(True, "Run the point-cloud baseline beside.")
    upload: Upload = option(
        "full", "Whole reports with Gaussians as measured (float), or on their lattice; or in short, flags first."
    )

    def __post_init__(self) -> None:
        check(self)
        if not self.vehicles:
            raise OptionError("--vehicles: at least one size of the fleet is needed")

    @property
    def fleet_size(self) -> int:
        """How many vehicles drive: the largest fleet, and every sensor at least once."""
        return max(*self.vehicles, len(self.sensors))


_MINUTE_NS: Final = 60 * 1_000_000_000


def fleet_sensors(options: RunOptions, seed: int) -> tuple[str, ...]:
    """Return the sensor of each vehicle, short names: the sensors in a seeded order, again and again."""
    order = np.random.default_rng([seed, 0xF1EE7]).permutation(len(options.sensors)).tolist()
    return tuple(options.sensors[order[index % len(order)]] for index in range(options.fleet_size))


def fleet_configs(options: RunOptions, seed: int) -> tuple[DriveConfig, ...]:
    """Return the drive of each vehicle through the world of a seed, in the order in which the fleet grows.

    Directions alternate, and each sensor drives both ways.
    """
    sensors, round_trip = fleet_sensors(options, seed), len(options.sensors)
    return tuple(
        DriveConfig(
            vehicle=f"vehicle-{index:02d}",
            sensor=SHORT_NAMES[sensor],
            direction=1 if (index + index // round_trip * (round_trip % 2 == 0)) % 2 == 0 else -1,
            seed=1_000_003 * seed + index,
            car_share=options.parking,
            traffic=Traffic.urban() if options.traffic else Traffic(),
            scans=options.scans,
            start_ns=EPOCH_NS + index * round(options.apart_min * _MINUTE_NS),
            weather=options.weather,
            beams=options.beams,
            stay_h=options.stay_h,
        )
        for index, sensor in enumerate(sensors)
    )
