"""The point-cloud baseline: crowd-sourced update of a point-cloud map (the GND paper's [44], its section 7.4)."""

from benchmarks.pcd.detector import PcdDetector
from benchmarks.pcd.errors import PcdCodecError, PcdError
from benchmarks.pcd.merge import merge_pcd
from benchmarks.pcd.parameters import PcdDetectParameters, PcdMergeParameters
from benchmarks.pcd.points import PcdMap, base_pcd, gnd_of
from benchmarks.pcd.report import PcdReport
from benchmarks.pcd.score import evaluate_gnd, settled

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
