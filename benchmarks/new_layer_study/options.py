"""What the study of new feature layers runs: everything that decides its numbers, and nothing else."""

from dataclasses import dataclass
from typing import Final

from benchmarks.feature_study.output import check_seeds
from benchmarks.simulation.errors import OptionError

MOST_DRIVES: Final = 60
_LEVELS: Final = (0.1, 5.0)
_KM: Final = (0.3, 20.0)


@dataclass(frozen=True, slots=True)
class NewLayerOptions:
    """One study.

    Attributes:
        seeds: of routes; each has its own beacons, lights and drives.
        drives: on the test track.
        motorway_drives: on the motorway; one more then drives with the layer that they made.
        levels: noise levels of Figure 8, of beacons and of lanes; none: no sweep.
        km: length of the motorway.
        straight: whether the straight motorway is driven, too.
    """

    seeds: tuple[int, ...] = (11,)
    drives: int = 6
    motorway_drives: int = 11
    levels: tuple[float, ...] = (0.5, 1.0, 1.5, 2.0)
    km: float = 4.0
    straight: bool = True

    def __post_init__(self) -> None:
        check_seeds(self.seeds)
        for name in ("drives", "motorway_drives"):
            if not 1 <= getattr(self, name) <= MOST_DRIVES:
                option = name.replace("_", "-")
                raise OptionError(f"--{option} must be 1 … {MOST_DRIVES}, got {getattr(self, name)}")
        wrong = [level for level in self.levels if not _LEVELS[0] <= level <= _LEVELS[1]]
        if wrong or len(set(self.levels)) != len(self.levels):
            raise OptionError(f"--levels must be different numbers {_LEVELS[0]:g} … {_LEVELS[1]:g}, got {self.levels}")
        if not _KM[0] <= self.km <= _KM[1]:
            raise OptionError(f"--km must be {_KM[0]:g} … {_KM[1]:g}, got {self.km:g}")
