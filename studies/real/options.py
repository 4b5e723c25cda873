"""What a run of `gnd reproduce real` is made of, checked before anything is read."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map import settings
from gnd.gnd_map.errors import GndError
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.importers.splits import chosen_scans
from gnd.vehicle_agent.segment.parameters import SegmentParameters
from studies.real.drive import Poses
from studies.real.errors import RealDataError
from studies.real.rounds import Method


@dataclass(frozen=True, slots=True)
class RealOptions:
    """scans: folder or file. kind: its format. map_scans, drive_scans: which scans make the map, which are driven.

    rounds: ways to lay the recording on the grid, each with other objects. objects: inserted a round, half of them into
    either half. at_most: scans that are read.
    """

    scans: Path
    kind: str = "auto"
    topic: str | None = None
    map_scans: str = "even"
    drive_scans: str = "odd"
    rounds: int = 4
    objects: int = 8
    seed: int = 0
    at_most: int = 200
    poses: Poses = "reference"
    segment: bool = True
    segment_map: bool = True
    mode: str = "default"
    changes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.rounds < 1 or self.objects < 0 or self.at_most < 4:
            raise RealDataError(
                f"rounds >= 1, objects >= 0 and at least 4 scans are needed, got {self.rounds}, {self.objects} and"
                f" {self.at_most}"
            )

    def method(self) -> Method:
        """How the vehicle works."""
        plain = DetectParameters.paper() if self.mode == "paper" else DetectParameters()
        segment = SegmentParameters(enabled=self.segment)
        return Method(changed(plain, self.changes), segment, self.segment and self.segment_map, self.poses)

    def halves(self, n: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Numbers of the mapping and the driven scans.

        Raises:
            RealDataError: a scan is in both.
            ImportDriveError: a rule that is none, or that leaves too few scans.
        """
        mapping, driving = chosen_scans(self.map_scans, n), chosen_scans(self.drive_scans, n)
        both = np.intersect1d(mapping, driving)
        if len(both):
            raise RealDataError(
                f"--map-scans {self.map_scans} and --drive-scans {self.drive_scans} share {len(both)} of {n} scans"
            )
        return mapping, driving

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return asdict(self) | {"scans": self.scans.name}


def changed(parameters: DetectParameters, changes: Sequence[str]) -> DetectParameters:
    """Parameters of detection with some replaced, each given as FIELD=VALUE.

    Raises:
        RealDataError: no such field, or a value that is none or out of its range.
    """
    try:
        return settings.changed(parameters, changes)
    except GndError as error:
        raise RealDataError(str(error)) from error
