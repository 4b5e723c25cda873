"""`gnd reproduce real-localisation`: everything that recordings allow, from options to the result and its tables."""

from collections.abc import Callable
from dataclasses import MISSING, dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, Final

from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importer import map_track, open_recording
from gnd.vehicle_agent.importers.cleaning import cleaned
from gnd.vehicle_agent.importers.detect_format import format_of
from gnd.vehicle_agent.importers.recording import NOMINAL, Recording
from gnd.vehicle_agent.importers.splits import chosen_scans
from studies.frame.command import Bench, StudyReport, study
from studies.frame.errors import RealDataError
from studies.frame.options import check, option
from studies.frame.tables import Sheet, sheet_of, shown
from studies.real.scene import RecordedScans, load, place
from studies.real_localisation.apollo import apollo_of
from studies.real_localisation.convergence import convergence_of
from studies.real_localisation.flexmap import flexmap_of, is_flexmap
from studies.real_localisation.halves import SPLITS, Half, localisation_of
from studies.real_localisation.nagoya import is_nagoya, nagoya_of
from studies.real_localisation.odometry import compared, odometries
from studies.real_localisation.pictures import draw_flexmap, draw_halves

_METHODS: Final = {"with_submap": "yes", "without_submap": "no", "without_submap_and_wheels": "no, no wheels"}
_ODOMETRY: Final = {
    "way m": "{way_m:.2f}",
    "less the positions' m": "{way_less_positions_m:.2f}",
    "from positions 50 / 95 % m": "{positions_m_p50:.2f} / {positions_m_p95:.2f}",
    "step from ours 95 % m / °": "{step_m_p95:.3f} / {step_deg_p95:.3f}",
    "end from ours along / across m": "{end_along_m:.2f} / {end_across_m:.2f}",
    "ms a scan": "{ms_per_scan:.0f}",
}
_ERRORS: Final = {
    "along m": "{errors.longitudinal_p95_m:.3f} ({errors.longitudinal_max_m:.3f})",
    "across m": "{errors.lateral_p95_m:.3f} ({errors.lateral_max_m:.3f})",
    "heading °": "{errors.heading_p95_deg:.3f} ({errors.heading_max_deg:.3f})",
}
_LOCALISED: Final = {"": "{half}", "submaps": "{submaps}", "good / localised / driven": "{count}", **_ERRORS,
                     "against": "{against}"}  # fmt: skip
_REGISTERED: Final = {
    "from": "{off_m} m, {off_deg}°",
    "method": "{method}",
    "converged": "{converged:.0%}",
    "not, and said so": "{not_and_said_so:.0%}",
    "not, and silent": "{not_and_silent:.0%}",
    "error 50 % m / °": "{error_m_p50:.3f} / {error_deg_p50:.3f}",
    "ms": "{ms_p50:.1f}",
}
_OFF: Final = "{{{0}.longitudinal_m:.3f}}, {{{0}.lateral_m:.3f}}, {{{0}.heading_deg:.3f}}"
_SEARCHED: Final = {
    "searched from 2.5 m, any heading": "{name}",
    "sure": "{sure} of {searches}",
    "Gaussians": "{gaussians}",
    "these off m, m, °": _OFF.format("largest_error_sure"),
    "all off m, m, °": _OFF.format("largest_error"),
}
_ON_APOLLO: Final = {
    "scan": "{scan}",
    "from": "{off_m} m, {off_deg}°",
    "within 10 cm": "{within_10_cm:.0%}",
    "along m": "{longitudinal_m:.3f}",
    "across m": "{lateral_m:.3f}",
    "heading °": "{heading_deg:.3f}",
}
_THREE: Final = "{{{0}.p50:.2f}} / {{{0}.p95:.2f}} / {{{0}.max:.2f}}"
_NAGOYA: Final = {
    "number": "{fixes}",
    "the fixes": _THREE.format("fixes_off_m"),
    "track, rigid": _THREE.format("rigid_off_m"),
    "track, bent": _THREE.format("off_m"),
    "heading °": _THREE.format("heading_deg"),
}
_FLEXMAP: Final = {
    "fixes used": _THREE.format("used"),
    "fixes held out": _THREE.format("held_out"),
    "of these in a lane": "{lane:.1%}",
}


def sheets_of(found: dict[str, Any]) -> list[Sheet]:
    """Return what was measured in each recording."""
    sheets = []
    for name, one in found.items():
        head = Sheet(f"{name}: {one['kind']}, {one['runtime_s']} s", notes=list(one.get("left_out", ())))
        sheets += [head, *_tables(one)]
    return sheets


def _tables(one: dict[str, Any]) -> list[Sheet]:
    registered = [
        sheet_of(f"Registration, {half['name']}", _REGISTERED, half["registration"])
        for half in one.get("halves", ())
        if half["registration"]
    ]
    if "odometry" in one:
        rows = {row["name"] + (f": {row['absent']}" if row["absent"] else ""): row for row in one["odometry"]}
        title = "Localised on the other part: poses called good, 95 % (largest)"
        localised = sheet_of(title, _LOCALISED, [row for half in one["halves"] for row in _localised(half)])
        return [sheet_of("Odometry", _ODOMETRY, rows), localised, *registered]
    if "on_apollos_map" in one:
        return [_searched(one), *registered, _apollo(one)]
    title = f"{one['poses']} poses over {one['way_m']:.0f} m"
    if "by" in one:
        rows = {row["name"]: row for row in one["by"]}
        return [sheet_of(f"{title} against the reference, 50 / 95 % / largest m", _NAGOYA, rows, "fixes")]
    of = {"used": one["used_m"], "held_out": one["held_out_m"], "lane": one["held_out_in_lanes"]}
    rows = {name: {key: values[name] for key, values in of.items()} for name in ("rigid", "bent")}
    return [sheet_of(f"{title}, distance of GNSS from the track, 50 / 95 % / largest m", _FLEXMAP, rows)]


def _localised(half: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows of a half: each way of localising against each reference, and the references against each other."""
    rows = []
    for method, submaps in _METHODS.items():
        one = half[method]
        count = f"{one['health'].get('good', 0)} / {one['localised']} / {half['driven']}"
        head = {"half": half["name"], "submaps": submaps, "count": count}
        rows += [head | {"errors": error, "against": name} for name, error in one["errors"].items()]
    empty = {"half": "", "submaps": "", "count": ""}
    return [*rows, empty | {"errors": half["gicp_less_track"], "against": "gicp less track"}]


def _searched(one: dict[str, Any]) -> Sheet:
    place = "Scan 2 lies at {lat_deg:.7f}°, {lon_deg:.7f}°, {height_m:.2f} m, heading {heading_deg:.2f}°"
    return sheet_of(shown(place, one["place"]), _SEARCHED, one["searches"])


def _apollo(one: dict[str, Any]) -> Sheet:
    apart = one["gaussians"]
    title = (
        f"On Apollo's own map ({apart['compared']} Gaussians, {100 * apart['along_normal_m_p50']:.1f} cm apart (50 %),"
        f" shifted by {', '.join(f'{100 * value:.1f}' for value in apart['shift_enu_m'])} cm east, north, up)"
    )
    return sheet_of(title, _ON_APOLLO, one["on_apollos_map"])


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
def real_localisation(options: RealLocalisationOptions, bench: Bench) -> StudyReport:
    """Odometry, localisation, registration and georeferencing on real recordings, beside KISS-ICP and small_gicp.

    A folder of scans (KITTI, RADIATE, PCD, MCAP) is halved: one half is the map, the other is localised on it. Two
    scans of Apollo are localised on each other and on Apollo's own map. Tracks with GNSS are put on the Earth.
    """
    found = reproduce_real_localisation(options, bench.folder.root if bench.pictures else None, bench.step)
    return StudyReport(found, sheets_of(found), file="real-localisation.json")


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
        return {"kind": "wheel and gyro, GNSS and reference", **nagoya_of(folder), "pictures": []}
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
    return apollo_of(folder, place(RecordedScans(recording.name, usable, map_track(recording), recording, ()), 0))


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
