"""What the trees learn from, and what they are tested on: no world and no recording in both, no reserved family in the
first.

Sensors: the trees learn from a VLP-16, an HDL-32E and an RS-LiDAR-16 (and from the real sensors of two recordings); an
RS-LiDAR-32, an HDL-64E and a Scala drive in tests only.
"""

from typing import Final

from gnd.fleet_sim.families.names import FAMILY_NAMES, RESERVED
from studies.modified_study.recorded import RecordingSpec
from studies.modified_study.simulated import DriveSpec, WorldSpec
from studies.real.study import Split

_SIXTEEN: Final = (
    DriveSpec("vlp16"),
    DriveSpec("hdl32e", parking=0.35, beams="real"),
    DriveSpec("rs16", weather="rain"),
)
_THIRTY_TWO: Final = (DriveSpec("hdl32e"), DriveSpec("rs16", parking=0.35), DriveSpec("vlp16", beams="real"))
TRAINING: Final = tuple(
    WorldSpec(family, seed, drives)
    for family, seed in (("street", 301), ("suburb", 303), ("avenue", 305), ("motorway", 307), ("snow", 309))
    for seed, drives in ((seed, _SIXTEEN), (seed + 1, _THIRTY_TWO))
)
"""Worlds of seeds below 1000, two of each family that is not reserved."""
_TEST_DRIVES: Final = (DriveSpec("vlp16"), DriveSpec("hdl32e"))
_OTHER_SENSORS: Final = (DriveSpec("rs32"), DriveSpec("hdl64e"), DriveSpec("scala"))
SEEN: Final = tuple(
    WorldSpec(family, 1101 + number, _TEST_DRIVES)
    for number, family in enumerate(FAMILY_NAMES)
    if family not in RESERVED
)
"""Families of the training, other worlds."""
UNSEEN: Final = tuple(
    WorldSpec(family, 1101 + number, _TEST_DRIVES) for number, family in enumerate(FAMILY_NAMES) if family in RESERVED
)
"""Families that no training may see."""
SENSORS: Final = (WorldSpec("street", 1121, _OTHER_SENSORS), WorldSpec("construction", 1122, _OTHER_SENSORS))
"""Sensors that no training has seen."""
_SPLITS: Final[tuple[tuple[Split, int, int], ...]] = (("alternate", 6, 2), ("halves", 4, 1))
"""How a recording is divided, and rounds of the training and of the tests."""
RECORDED_TRAINING: Final = tuple(
    RecordingSpec(folder, split, rounds)
    for folder in ("kitti00_start16", "radiate_fog")
    for split, rounds, _ in _SPLITS
)
RECORDED_TESTS: Final = tuple(
    RecordingSpec(folder, split, rounds, seed=8)
    for folder in ("kitti_raw_0027", "kitti_raw_0060")
    for split, _, rounds in _SPLITS
)
"""Recordings that nothing is tuned on."""
