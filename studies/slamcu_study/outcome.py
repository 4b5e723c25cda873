"""A finished study of SLAMCU."""

from collections.abc import Mapping
from dataclasses import dataclass

from gnd.gnd_map.arrays import F64, I64
from studies.slamcu_study.options import FULL, SlamcuOptions
from studies.slamcu_study.verdicts import SignTruth, Verdicts


@dataclass(frozen=True, slots=True, eq=False)
class MergedSigns:
    """The layer that the cloud publishes after all drives.

    Attributes:
        known_id: int64 (K,), signs of the map before that are still published.
        new_xy_m: float64 (J, 2), published signs that the map before had not, map frame.
        new_cov_m2: float64 (J, 2, 2).
    """

    known_id: I64
    new_xy_m: F64
    new_cov_m2: F64


@dataclass(frozen=True, slots=True, eq=False)
class SeedOutcome:
    """What came of one route.

    Attributes:
        seed: of the route.
        truth: its signs.
        variants: what the first vehicle says, by variant.
        drives: what each vehicle says; the first as in `variants`.
        merged: by number of vehicles.
    """

    seed: int
    truth: SignTruth
    variants: Mapping[str, Verdicts]
    drives: tuple[Verdicts, ...]
    merged: Mapping[int, MergedSigns]

    @property
    def first(self) -> Verdicts:
        """The paper's one drive."""
        return self.variants[FULL]


@dataclass(frozen=True, slots=True, eq=False)
class StudyOutcome:
    """Everything."""

    options: SlamcuOptions
    seeds: tuple[SeedOutcome, ...]
    runtime_s: Mapping[str, float]
