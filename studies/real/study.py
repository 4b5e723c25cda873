"""`gnd reproduce real`: change detection on a real recording, from options to the result."""

from collections.abc import Callable, Sequence
from dataclasses import MISSING, asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map import settings
from gnd.gnd_map.errors import GndError
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.importer import AUTO, open_recording
from gnd.vehicle_agent.importers.detect_format import format_of
from gnd.vehicle_agent.importers.recording import NOMINAL, Recording
from gnd.vehicle_agent.importers.splits import chosen_scans
from gnd.vehicle_agent.segment.parameters import SegmentParameters
from studies.frame.command import Bench, StudyReport, study
from studies.frame.errors import RealDataError
from studies.frame.options import check, option
from studies.real.drive import Poses
from studies.real.rounds import Method, Round, run_round
from studies.real.scene import load
from studies.real.scores import sheets_of, summary_of

Progress = Callable[[str, int, int], None]
Split = Literal["alternate", "halves"]
SPLITS: Final[dict[Split, tuple[str, str]]] = {"alternate": ("even", "odd"), "halves": ("first-half", "second-half")}
"""The scans that make the map, and those that are driven."""


@dataclass(frozen=True, slots=True)
class RealOptions:
    """What a run is made of. Each round lays the recording on the grid in another way, with other objects."""

    scans: Path = option(MISSING, "Folder of KITTI .bin, PCD or RADIATE scans, or MCAP file.")
    kind: str = option(AUTO, "kitti, pcd, mcap, radiate or auto.", "--format")
    topic: str | None = option(None, "Topic of the clouds, for an MCAP file with several.")
    split: Split = option(
        "alternate", "Every other scan makes the map, or the first half of the drive does; the others are driven."
    )
    map_scans: str | None = option(None, "Scans that make the map, in place of the split's.")
    drive_scans: str | None = option(None, "Scans that are driven, in place of the split's.")
    rounds: int = option(4, "Ways to lay the recording on the grid, with new objects.", span=(1, None))
    objects: int = option(8, "Objects a round, half of them into either half.", span=(0, None))
    seed: int = option(0, "Of the ways on the grid and the places of objects.")
    at_most: int = option(200, "At most so many scans are read.", "--first", span=(4, None))
    poses: Poses = option("reference", "Where the drive's poses come from.")
    segment: bool = option(True, "Motion segmentation.")
    segment_map: bool = option(True, "Of the map's scans, too.")
    mode: Literal["default", "paper"] = option("default", "Whose rules.")
    changes: tuple[str, ...] = option((), "Replace a parameter of detection, FIELD=VALUE.", "--set", repeated=True)

    def __post_init__(self) -> None:
        check(self)

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
        maps, drives = SPLITS[self.split]
        maps, drives = self.map_scans or maps, self.drive_scans or drives
        mapping, driving = chosen_scans(maps, n), chosen_scans(drives, n)
        both = np.intersect1d(mapping, driving)
        if len(both):
            raise RealDataError(f"--map-scans {maps} and --drive-scans {drives} share {len(both)} of {n} scans")
        return mapping, driving


def changed(parameters: DetectParameters, changes: Sequence[str]) -> DetectParameters:
    """Parameters of detection with some replaced, each given as FIELD=VALUE.

    Raises:
        RealDataError: no such field, or a value that is none or out of its range.
    """
    try:
        return settings.changed(parameters, changes)
    except GndError as error:
        raise RealDataError(str(error)) from error


@study(RealOptions, out="runs/reproduce-real", marked=False)
def real(options: RealOptions, bench: Bench) -> StudyReport:
    """Change detection on a real recording: part of the scans makes the map, the vehicle drives the others.

    Objects are inserted ray-accurately into the map's scans (they are gone, then) and into the vehicle's (they are
    new); the untouched scans tell how much is reported although nothing changed.
    """
    found = reproduce_real(options, bench.step)
    return StudyReport(found, sheets_of(found), file=f"{found['recording']}.json")


def reproduce_real(options: RealOptions, progress: Progress) -> dict[str, Any]:
    """Measure detection on a recording; give the result as plain values.

    Args:
        options: what to do.
        progress: called with a step's name, how much is done, and of how much.

    Raises:
        RealDataError: too few scans, or options that do not fit the recording.
        ImportDriveError, DriveError: the recording cannot be read.
    """
    begin_s, method = perf_counter(), options.method()
    recording = _opened(options)
    options.halves(min(len(recording), options.at_most))  # wrong rules are told before the long work
    recorded = load(recording, options.at_most, progress)
    halves = options.halves(len(recorded.scans))
    rounds: list[Round] = []
    for number in range(options.rounds):
        rounds.append(run_round(recorded, halves, number, options.objects, options.seed, method))
        progress("rounds", number + 1, options.rounds)
    return {
        "recording": recorded.name,
        "scans": len(recorded.scans),
        "left_out": list(recorded.left_out),
        **summary_of(rounds),
        "options": asdict(options) | {"scans": options.scans.name},
        "parameters": {"detect": asdict(method.detect), "segment": asdict(method.segment)},
        "runtime_s": round(perf_counter() - begin_s, 1),
    }


def _opened(options: RealOptions) -> Recording:
    """The recording; where its format does not tell the place, it lies at a nominal one, which does not matter here."""
    kind = format_of(options.scans) if options.kind == AUTO else options.kind
    return open_recording(kind, options.scans, NOMINAL if kind == "pcd" else None, options.topic)
