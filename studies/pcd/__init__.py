"""The point-cloud baseline: crowd-sourced update of a point-cloud map (the GND paper's [44], its section 7.4)."""

from studies.pcd.detector import PcdDetector
from studies.pcd.merge import evaluate_gnd, merge_pcd, settled
from studies.pcd.points import (
    PcdError,
    PcdMap,
    base_pcd,
    gnd_of,
)
from studies.pcd.report import PcdReport

__all__ = [
    "PcdDetector",
    "PcdError",
    "PcdMap",
    "PcdReport",
    "base_pcd",
    "evaluate_gnd",
    "gnd_of",
    "merge_pcd",
    "settled",
]
