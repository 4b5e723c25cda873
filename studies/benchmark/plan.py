"""What an export holds: its worlds, the drives through each, and how large that becomes."""

from dataclasses import dataclass, replace
from typing import Any, Final, Literal

from gnd.fleet_sim.drives import DriveConfig
from gnd.fleet_sim.families.names import FAMILY_NAMES
from gnd.fleet_sim.sensors import SHORT_NAMES
from gnd.fleet_sim.street import MAX_LENGTH_M, MIN_LENGTH_M, StreetOptions
from studies.frame.errors import OptionError
from studies.frame.options import check, numbers, option
from studies.simulation.options import RunOptions, fleet_configs, fleet_sensors

Size = Literal["small", "full"]


@dataclass(frozen=True, slots=True)
class _Preset:
    """What a size stands for."""

    families: tuple[str, ...]
    world_seeds: tuple[int, ...]
    vehicles: int
    sensors: tuple[str, ...]
    length_m: float


PRESETS: Final[dict[Size, _Preset]] = {
    "small": _Preset(("street", "suburb", "construction"), (7001,), 3, ("vlp16",), 100.0),
    "full": _Preset(FAMILY_NAMES, (7001, 7002), 5, ("vlp16", "rs32"), 200.0),
}
"""No parameter of ours was chosen by these seeds (all tuning is below 1000), and four of the nine families are
reserved for tests (`gnd.fleet_sim.families.names.RESERVED`)."""

_GB_A_RETURN: Final = (20 + 11) / 1e9
"""20 bytes in a scan's file and about 11 in the MCAP file."""
_RETURNS_OF_SHOTS: Final = 0.75
_DRIVE_MPS: Final = 7.5
"""What a drive through a short street comes to, with the way to get going."""
_S_A_MILLION_SHOTS: Final = 1.2
_S_A_METRE: Final = 0.06


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """One export. What is None is as the size says."""

    size: Size = option("small", "small: three worlds; full: all nine families, two worlds of each.")
    families: tuple[str, ...] | None = option(None, f"Kinds of places: {', '.join(FAMILY_NAMES)}.", known=FAMILY_NAMES)
    world_seeds: tuple[int, ...] | None = option(
        None, "Seeds of each family's worlds, such as 7001,7005-7009.",
        read=lambda text: numbers("--world-seeds", text), span=(0, None),
    )  # fmt: skip
    vehicles: int | None = option(None, "Vehicles that drive through each world.", span=(1, 200))
    sensors: tuple[str, ...] | None = option(
        None, f"LiDARs that they cycle through: {', '.join(SHORT_NAMES)}.", known=SHORT_NAMES
    )
    length: float | None = option(None, "Length of each street, metres.", span=(MIN_LENGTH_M, MAX_LENGTH_M))
    scans: int | None = option(None, "At most so many scans a drive, for a quick look.", span=(1, None))

    def __post_init__(self) -> None:
        check(self)
        for flag, many in (("--families", self.families), ("--world-seeds", self.world_seeds)):
            if many is not None and (not many or len(set(many)) != len(many)):
                raise OptionError(f"{flag}: at least one, each once, got {', '.join(map(str, many)) or 'none'}")

    @property
    def chosen(self) -> dict[str, Any]:
        """Everything that decides the files, as plain values."""
        preset = PRESETS[self.size]
        return {
            "families": list(self.families or preset.families),
            "world_seeds": list(self.world_seeds or preset.world_seeds),
            "vehicles": self.vehicles or preset.vehicles,
            "sensors": list(self.sensors or preset.sensors),
            "length_m": self.length or preset.length_m,
            "scans": self.scans,
        }


@dataclass(frozen=True, slots=True)
class PlannedDrive:
    """One drive: the name of its vehicle, its sensor, and what is simulated."""

    sensor: str
    config: DriveConfig

    @property
    def vehicle(self) -> str:
        """The name of the vehicle."""
        return self.config.vehicle


@dataclass(frozen=True, slots=True)
class PlannedWorld:
    """One world and its drives."""

    family: str
    seed: int
    street: StreetOptions
    drives: tuple[PlannedDrive, ...]

    @property
    def name(self) -> str:
        """The name of its folder."""
        return f"{self.family}-{self.seed}"


def planned_worlds(options: ExportOptions) -> tuple[PlannedWorld, ...]:
    """Return the worlds of an export; drives as those of `gnd reproduce simulation`: parked cars, traffic, an hour
    apart.
    """
    chosen, found = options.chosen, []
    for family in chosen["families"]:
        place = StreetOptions(length_m=chosen["length_m"], site="wangsimni", family=family)
        for seed in chosen["world_seeds"]:
            run = RunOptions((seed,), place, (chosen["vehicles"],), tuple(chosen["sensors"]), scans=chosen["scans"])
            drives = zip(fleet_sensors(run, seed), fleet_configs(run, seed), strict=True)
            found.append(PlannedWorld(family, seed, place, tuple(_drives(drives, chosen["vehicles"]))))
    return tuple(found)


def _drives(pairs: Any, number: int) -> list[PlannedDrive]:
    """The first drives; a fleet of the study has every sensor at least once."""
    return [PlannedDrive(sensor, replace(config)) for sensor, config in list(pairs)[:number]]


@dataclass(frozen=True, slots=True)
class Expected:
    """What an export costs, about: gigabytes, and minutes of one core."""

    gigabytes: float
    core_minutes: float


def expected(worlds: tuple[PlannedWorld, ...]) -> Expected:
    """Return what an export will cost, about, from what those of the small size cost."""
    shots, metres = 0.0, 0.0
    for world in worlds:
        metres += world.street.length_m
        for drive in world.drives:
            model = drive.config.model
            seconds = world.street.length_m / _DRIVE_MPS
            if drive.config.scans is not None:
                seconds = min(seconds, drive.config.scans / model.rate_hz)
            shots += len(model.elevations_rad) / model.cycle_ns * 1e9 * seconds
    return Expected(
        shots * _RETURNS_OF_SHOTS * _GB_A_RETURN, (shots / 1e6 * _S_A_MILLION_SHOTS + metres * _S_A_METRE) / 60.0
    )
