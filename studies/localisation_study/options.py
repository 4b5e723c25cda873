"""What the study of localisation runs: everything that decides its numbers, and nothing else."""

from dataclasses import dataclass, field
from math import tau

from gnd.fleet_sim.drives import EPOCH_NS, DriveConfig
from gnd.fleet_sim.sensors import MODELS, SHORT_NAMES
from gnd.fleet_sim.street import StreetOptions
from gnd.fleet_sim.traffic import Traffic
from studies.simulation.errors import OptionError
from studies.simulation.method import MethodParameters
from studies.simulation.options import Base, RunOptions
from studies.simulation.pose_source import PoseSource

FLEET_SENSORS = ("vlp16", "hdl32e", "rs16", "rs32")
_STUDY_SEEDS = 700  # drive seeds of the fleet lie below
_DAY_NS = 86_400 * 1_000_000_000


@dataclass(frozen=True, slots=True)
class StudyOptions:
    """One study.

    Attributes:
        seeds: world seeds; of several, the worst counts.
        street: length and place.
        sensors: short names; each drives once.
        fleet: vehicles whose reports update the map.
        fleet_sensors: short names; the fleet cycles through them.
        poses: where the fleet's poses come from.
        trials: starts a sensor without any pose.
        variant_sensors: sensors that also run with added errors; None for the first of all that drive.
        parking: share of parking slots that are taken.
        base: "driven": maps are made by an HDL-32E with range noise on the empty street; "surveyed": the truth's own.
        scans: at most so many scans a drive, None for the whole street.
        method: all parameters of the method.
    """

    seeds: tuple[int, ...] = (201,)
    street: StreetOptions = field(default_factory=lambda: StreetOptions(300.0, "wangsimni"))
    sensors: tuple[str, ...] = ("vlp16", "hdl64e", "scala")
    fleet: int = 5
    fleet_sensors: tuple[str, ...] = FLEET_SENSORS
    poses: PoseSource = field(default_factory=lambda: PoseSource("estimated", 0.0, 0.0))
    trials: int = 20
    variant_sensors: tuple[str, ...] | None = None
    parking: float = 0.2
    base: Base = "driven"
    scans: int | None = None
    method: MethodParameters = field(default_factory=MethodParameters)

    def __post_init__(self) -> None:
        for name, least in (("fleet", 1), ("trials", 0)):
            if getattr(self, name) < least:
                raise OptionError(f"--{name} must be at least {least}, got {getattr(self, name)}")
        _check_sensors("sensors", self.sensors)
        for sensor in self.variants_of:
            if sensor not in self.sensors:
                raise OptionError(f"--variants: {sensor!r} does not drive; driving are {', '.join(self.sensors)}")
        self._fleet_of(self.seeds)  # which checks all that it takes over

    @property
    def variants_of(self) -> tuple[str, ...]:
        """The sensors that also run with added errors."""
        return self.sensors[:1] if self.variant_sensors is None else self.variant_sensors

    def of_fleet(self, seed: int) -> RunOptions:
        """Return the run that maps the world of a seed and updates the map.

        Raises:
            OptionError: a seed, share or number that cannot be.
        """
        return self._fleet_of((seed,))

    def _fleet_of(self, seeds: tuple[int, ...]) -> RunOptions:
        return RunOptions(
            seeds=seeds,
            street=self.street,
            vehicles=(self.fleet,),
            sensors=self.fleet_sensors[: self.fleet],
            parking=self.parking,
            poses=self.poses,
            base=self.base,
            method=self.method,
            scans=self.scans,
            pcd=False,
        )


def _check_sensors(option: str, sensors: tuple[str, ...]) -> None:
    unknown = [name for name in sensors if name not in SHORT_NAMES]
    if unknown or not sensors:
        wrong = ", ".join(unknown) or "(none)"
        raise OptionError(f"--{option}: unknown sensor {wrong}; known are {', '.join(SHORT_NAMES)}")
    if len(set(sensors)) != len(sensors):
        raise OptionError(f"--{option}: each sensor drives once, got {', '.join(sensors)}")


def looks_around(sensor: str) -> bool:
    """Whether a sensor, by its short name, sweeps a whole turn."""
    return MODELS[SHORT_NAMES[sensor]].span_rad == tau


def drive_config(options: StudyOptions, seed: int, sensor: str) -> DriveConfig:
    """Return the drive of a sensor through the changed world; the same whichever other sensors drive."""
    index = list(SHORT_NAMES).index(sensor)
    return DriveConfig(
        vehicle=f"study-{sensor}",
        sensor=SHORT_NAMES[sensor],
        state="after",
        direction=1 if index % 2 == 0 else -1,
        seed=1_000_003 * seed + _STUDY_SEEDS + index,
        car_share=options.parking,
        traffic=Traffic.urban(),
        scans=options.scans,
        start_ns=EPOCH_NS + 10 * _DAY_NS,
    )
