"""`gnd reproduce real-localisation`: everything that recordings allow, from options to the result."""

from collections.abc import Callable
from dataclasses import MISSING, dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importer import map_track, open_recording
from gnd.vehicle_agent.importers.cleaning import cleaned
from gnd.vehicle_agent.importers.detect_format import format_of
from gnd.vehicle_agent.importers.recording import NOMINAL, Recording
from gnd.vehicle_agent.importers.splits import chosen_scans
from studies.frame.command import Bench, Report, study
from studies.frame.errors import RealDataError
from studies.frame.options import check, option
from studies.real.scene import Recorded, load, place
from studies.real_localisation.apollo import apollo_of
from studies.real_localisation.convergence import convergence_of
from studies.real_localisation.flexmap import flexmap_of, is_flexmap
from studies.real_localisation.halves import SPLITS, Half, localisation_of
from studies.real_localisation.nagoya import is_nagoya, nagoya_of
from studies.real_localisation.odometry import compared, odometries
from studies.real_localisation.pictures import draw_flexmap, draw_halves, draw_nagoya
from studies.real_localisation.tables import sheets_of

REGISTERED = 2
"""Registration from offsets is measured on so many of the splits."""


Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class RealLocalisationOptions:
    """What a run is made of: recordings with LiDAR, or to georeference."""

    scans: tuple[Path, ...] = option(
        MISSING,
        "Folders of recordings, with commas between them.",
        read=lambda text: tuple(Path(part.strip()) for part in text.split(",") if part.strip()),
    )
    at_most: int = option(200, "At most so many scans of each are read.", "--first", span=(4, None))
    seed: int = option(0, "Of the offsets from which registration starts.")

    def __post_init__(self) -> None:
        check(self)
        missing = [str(path) for path in self.scans if not path.exists()]
        if missing or not self.scans:
            raise RealDataError(f"--scans {', '.join(missing) or 'none'}: no such file or folder")
        names = [path.name for path in self.scans]
        if len(set(names)) != len(names):
            raise RealDataError(f"--scans {', '.join(names)}: one name twice would share its results")


@study(RealLocalisationOptions, out="runs/real-localisation", marked=False)
def real_localisation(options: RealLocalisationOptions, bench: Bench) -> Report:
    """Odometry, localisation, registration and georeferencing on real recordings, beside KISS-ICP and small_gicp.

    A folder of scans (KITTI, RADIATE, PCD, MCAP) is halved: one half is the map, the other is localised on it. Two
    scans of Apollo are localised on each other and on Apollo's own map. Tracks with GNSS are put on the Earth.
    """
    found = reproduce_real_localisation(options, bench.folder.root if bench.pictures else None, bench.step)
    return Report(found, sheets_of(found), file="real-localisation.json")


def reproduce_real_localisation(
    options: RealLocalisationOptions, out: Path | None, progress: Progress
) -> dict[str, Any]:
    """Measure everything that the folders allow; plain values, one entry a folder.

    Args:
        options: what to do.
        out: folder for pictures, None for none.
        progress: called with a step's name, how much is done, and of how much.

    Raises:
        RealDataError, RealDataError: a folder in which nothing can be measured.
        ImportDriveError: a recording that cannot be read.
    """
    found: dict[str, Any] = {}
    for number, folder in enumerate(options.scans):
        progress("recordings", number, len(options.scans))
        begin_s = perf_counter()
        found[folder.name] = _measured(folder, options, out, progress)
        found[folder.name]["runtime_s"] = round(perf_counter() - begin_s, 1)
    progress("recordings", len(options.scans), len(options.scans))
    return found


def _measured(folder: Path, options: RealLocalisationOptions, out: Path | None, progress: Progress) -> dict[str, Any]:
    if folder.is_dir() and is_flexmap(folder):
        result, drawn = flexmap_of(folder)
        files = [] if out is None else draw_flexmap(drawn, folder.name, out)
        return {"kind": "track and GNSS without times", **result, "pictures": _names(files)}
    if folder.is_dir() and is_nagoya(folder):
        result, tracks = nagoya_of(folder)
        files = [] if out is None else draw_nagoya(folder, tracks, folder.name, out)
        return {"kind": "wheel and gyro, GNSS and reference", **result, "pictures": _names(files)}
    recording, kind = _opened(folder)
    if kind == "apollo" and len(recording) == 2:
        return {"kind": "two scans with poses and Apollo's map", **_pair(folder, recording)}
    return {"kind": "scans", **_scans(recording, options, out, progress)}


def _opened(folder: Path) -> tuple[Recording, str]:
    """The recording; where its format does not tell the place, it lies at a nominal one, which does not matter here."""
    kind = format_of(folder)
    return open_recording(kind, folder, NOMINAL if kind == "pcd" else None), kind


def _names(files: list[Path]) -> list[str]:
    return [path.name for path in files]


def _pair(folder: Path, recording: Recording) -> dict[str, Any]:
    scans = [cleaned(recording.read(i)).scan for i in range(len(recording))]
    usable = tuple(scan for scan in scans if scan is not None)
    if len(usable) != len(scans):
        raise ImportDriveError(f"{recording.name}: {len(usable)} of {len(scans)} scans have a usable point")
    return apollo_of(folder, place(Recorded(recording.name, usable, map_track(recording), recording, ()), 0))


def _scans(
    recording: Recording, options: RealLocalisationOptions, out: Path | None, progress: Progress
) -> dict[str, Any]:
    recorded = load(recording, options.at_most, progress)
    for rules in SPLITS:  # a recording too short for them is told before the long work
        for rule in rules:
            chosen_scans(rule, len(recorded.scans))
    scene, tracks = place(recorded, 0), odometries(recorded)
    rows: list[dict[str, Any]] = []
    halves = [Half.of(scene, *rules) for rules in SPLITS]
    for number, half in enumerate(halves):
        progress("localisation and registration", number, len(halves))
        registration = convergence_of(half, options.seed) if number < REGISTERED else []
        rows.append(localisation_of(half) | {"registration": registration})
    progress("localisation and registration", len(halves), len(halves))
    return {
        "scans": len(recorded.scans),
        "left_out": list(recorded.left_out),
        "odometry": compared(tracks, recorded),
        "halves": rows,
        "pictures": [] if out is None else _names(draw_halves(recorded, tracks, halves, out)),
    }
