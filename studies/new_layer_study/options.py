"""What the study of new feature layers runs: everything that decides its numbers, and nothing else."""

from dataclasses import dataclass
from typing import Final

from studies.feature_study.output import check_seeds
from studies.simulation.errors import OptionError

MOST_DRIVES: Final = 60
_LEVELS: Final = (0.1, 5.0)
_KM: Final = (0.5, 20.0)
_BIAS_M: Final = 20.0
_LAP_M: Final = (100.0, 10_000.0)


@dataclass(frozen=True, slots=True)
class NewLayerOptions:
    """One study.

    Attributes:
        seeds: of routes; each has its own beacons, lights and drives.
        drives: on the test track.
        motorway_drives: on the motorway; one more then drives with the layer that they made.
        lap_m: way driven on the test track; 0: one lap. Beacons that a shorter way does not pass are missed.
        levels: noise levels of Figure 8, of beacons and of lanes; none: no sweep.
        sweep_seeds: on so many of the seeds, the first ones.
        km: length of the motorway.
        gnss_bias_m: standard deviation of a constant GNSS error of each axis, drawn for each drive on the motorways.
        straight_seeds: the straight motorway is driven, too, on so many of the seeds, the first ones.
    """

    seeds: tuple[int, ...] = (11,)
    drives: int = 6
    motorway_drives: int = 11
    lap_m: float = 0.0
    levels: tuple[float, ...] = (0.5, 1.0, 2.0)
    sweep_seeds: int = 1
    km: float = 4.0
    gnss_bias_m: float = 0.0
    straight_seeds: int = 1

    def __post_init__(self) -> None:
        check_seeds(self.seeds)
        for name in ("drives", "motorway_drives"):
            if not 1 <= getattr(self, name) <= MOST_DRIVES:
                option = name.replace("_", "-")
                raise OptionError(f"--{option} must be 1 … {MOST_DRIVES}, got {getattr(self, name)}")
        wrong = [level for level in self.levels if not _LEVELS[0] <= level <= _LEVELS[1]]
        if wrong or len(set(self.levels)) != len(self.levels):
            raise OptionError(f"--levels must be different numbers {_LEVELS[0]:g} … {_LEVELS[1]:g}, got {self.levels}")
        if self.lap_m and not _LAP_M[0] <= self.lap_m <= _LAP_M[1]:
            raise OptionError(f"--lap must be 0 or {_LAP_M[0]:g} … {_LAP_M[1]:g} m, got {self.lap_m:g}")
        if not 0.0 <= self.gnss_bias_m <= _BIAS_M:
            raise OptionError(f"--gnss-bias must be 0 … {_BIAS_M:g} m, got {self.gnss_bias_m:g}")
        for name in ("sweep_seeds", "straight_seeds"):
            if getattr(self, name) < 0:
                raise OptionError(f"--{name.replace('_', '-')} must be at least 0, got {getattr(self, name)}")
        if not _KM[0] <= self.km <= _KM[1]:
            raise OptionError(f"--km must be {_KM[0]:g} … {_KM[1]:g}, got {self.km:g}")
