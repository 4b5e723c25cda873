"""The paper's results, and what we set out to reach. Source: Kim, Cho, Sunwoo and Jo, Crowd-Sourced Mapping of New
Feature Layer for High-Definition Map, Sensors 18(12), 2018.
"""

from collections.abc import Mapping
from typing import Final

from studies.traffic_study.targets import Target

CASES: Final = ("without_map", "with_map", "integration")
DIRECTIONS: Final = ("euclidean", "lateral", "longitudinal")

PAPER_SINGLE_M: Final = {"without_map": (1.372, 0.810), "with_map": (0.647, 0.357)}
"""Section 5.2, Figure 6: mean and standard deviation over the beacons."""
PAPER_INTEGRATED_M: Final = {1: 0.56, 6: 0.14}
"""Section 5.2, Figure 7: mean error by number of drives, as far as the text tells it."""
PAPER_TABLE2: Final[Mapping[str, Mapping[str, tuple[float, float]]]] = {
    "without_map": {"euclidean": (5.2718, 0.6877), "lateral": (0.4651, 0.2506), "longitudinal": (5.2445, 0.6944)},
    "with_map": {"euclidean": (4.5284, 0.6418), "lateral": (0.1825, 0.1564), "longitudinal": (4.5220, 0.6418)},
    "integration": {"euclidean": (0.5458, 0.3543), "lateral": (0.1184, 0.0939), "longitudinal": (0.5181, 0.3638)},
}
"""Table 2, 11 drives on a motorway: mean and standard deviation, m."""
PAPER_TABLE3: Final = {
    "without": {"lateral": 0.2214, "longitudinal": 5.4138},
    "with": {"lateral": 0.2077, "longitudinal": 0.6261},
}
"""Table 3: root mean square errors of localisation, m."""

TARGETS: Final = (
    Target("beacons, one drive without map", "single_without_map", "m", "1.372", 1.372, 1.372),
    Target("beacons, one drive with map", "single_with_map", "m", "0.647", 0.647, 0.4),
    Target("beacons, 6 drives", "integrated.6", "m", "0.14", 0.14, 0.10),
    Target("lights, integrated, Euclidean", "motorway.euclidean", "m", "0.546", 0.5458, 0.3),
    Target("lights, integrated, lateral", "motorway.lateral", "m", "0.118", 0.1184, 0.1184),
    Target("lights, integrated, longitudinal", "motorway.longitudinal", "m", "0.518", 0.5181, 0.3),
    Target("localisation with layer, longitudinal", "localisation.with", "m", "0.63", 0.63, 0.4),
)
