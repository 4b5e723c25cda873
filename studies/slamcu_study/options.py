"""What the study of SLAMCU runs: everything that decides its numbers, and nothing else."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from studies.feature_study.output import check_seeds
from studies.simulation.errors import OptionError
from studies.slamcu_study.faults import check_faults

FULL: Final = "full"
VARIANTS: Final[Mapping[str, str]] = {
    FULL: "as it is",
    "no_occlusion": "hidden signs counted as unseen",
    "no_rbpf": "pose of GNSS and dead reckoning",
    "lidar": "pose of the LiDAR localiser",
}
"""The first is the method; the others show what matters."""
MOST_DRIVES: Final = 100
_KM: Final = (5.0, 100.0)


@dataclass(frozen=True, slots=True)
class SlamcuOptions:
    """One study.

    Attributes:
        seeds: of routes; each has its own signs, changes and drives.
        drives: vehicles whose reports are merged; the first of them is the paper's one drive.
        km: length of the motorway; the number of signs follows it.
        ablations: whether the first vehicle drives once more with each variant.
        faults: of `FAULTS`, in every drive.
    """

    seeds: tuple[int, ...] = (11,)
    drives: int = 10
    km: float = 20.0
    ablations: bool = True
    faults: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_seeds(self.seeds)
        check_faults(self.faults)
        if not 1 <= self.drives <= MOST_DRIVES:
            raise OptionError(f"--drives must be 1 … {MOST_DRIVES}, got {self.drives}")
        if not _KM[0] <= self.km <= _KM[1]:
            raise OptionError(f"--km must be {_KM[0]:g} … {_KM[1]:g}, got {self.km:g}")

    @property
    def variants(self) -> tuple[str, ...]:
        """What the first vehicle runs."""
        return tuple(VARIANTS) if self.ablations else (FULL,)
