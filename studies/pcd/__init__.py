"""The point-cloud baseline: crowd-sourced update of a point-cloud map (the GND paper's [44], its section 7.4)."""

from studies.pcd.detector import PcdDetector
from studies.pcd.errors import PcdCodecError, PcdError
from studies.pcd.merge import merge_pcd
from studies.pcd.parameters import PcdDetectParameters, PcdMergeParameters
from studies.pcd.points import PcdMap, base_pcd, gnd_of
from studies.pcd.report import PcdReport
from studies.pcd.score import evaluate_gnd, settled

__all__ = [
    "PcdCodecError",
    "PcdDetectParameters",
    "PcdDetector",
    "PcdError",
    "PcdMap",
    "PcdMergeParameters",
    "PcdReport",
    "base_pcd",
    "evaluate_gnd",
    "gnd_of",
    "merge_pcd",
    "settled",
]
