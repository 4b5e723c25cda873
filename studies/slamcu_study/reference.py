"""The paper's results, and what we set out to reach. Source: Jo, Kim and Sunwoo, Simultaneous Localization and Map
Change Update for the High Definition Map-Based Autonomous Driving Car, Sensors 18(9), 2018.
"""

from typing import Final

from studies.traffic_study.targets import Target

TRUE_CLASSES: Final = ("normal", "deleted", "new")
PREDICTED: Final = ("normal", "deleted", "new", "unclassified")

PAPER_CONFUSION: Final = ((54, 1, 0, 0), (0, 9, 0, 0), (0, 0, 36, 3))
"""Table 1: rows true, columns predicted."""
PAPER_ACCURACY: Final = {"normal": 98.0, "deleted": 100.0, "new": 92.0, "overall": 96.12}
PAPER_POSITION_M: Final = {"mean": 0.8, "std": 0.9}
"""Section 6.4, Figure 9."""
PAPER_STEP_MS: Final = 30.39
"""Section 6.1: mean, Core i5-4670."""
PAPER_LAMBDA: Final = 0.9
PAPER_LAMBDA_HD: Final = 0.95
"""Section 6.2."""

TARGETS: Final = (
    Target("accuracy, normal", "accuracy.normal", "%", "98", 98.0, 98.0, larger=True),
    Target("accuracy, deleted", "accuracy.deleted", "%", "100", 100.0, 100.0, larger=True),
    Target("accuracy, new", "accuracy.new", "%", "92", 92.0, 92.0, larger=True),
    Target("accuracy, overall", "accuracy.overall", "%", "96.12", 96.12, 99.0, larger=True),
    Target("position of new signs, one drive", "position_error_m.mean", "m", "0.8", 0.8, 0.4),
    Target("position of new signs, merged", "position_error_10_m.mean", "m", "", 0.3, 0.15),
    Target("one step, median", "step_ms_median", "ms", "30.39", 10.0, 2.0),
)
