"""`gnd reproduce real-localisation`: everything that recordings allow, from options to the result and its tables."""

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
from studies.frame.tables import Sheet, fixed, several, sheet
from studies.real.scene import Recorded, load, place
from studies.real_localisation.apollo import apollo_of
from studies.real_localisation.convergence import convergence_of
from studies.real_localisation.flexmap import flexmap_of, is_flexmap
from studies.real_localisation.halves import SPLITS, Half, localisation_of
from studies.real_localisation.nagoya import is_nagoya, nagoya_of
from studies.real_localisation.odometry import compared, odometries
from studies.real_localisation.pictures import draw_flexmap, draw_halves, draw_nagoya

_METHODS = {"with_submap": "yes", "without_submap": "no", "without_submap_and_wheels": "no, no wheels"}


def sheets_of(found: dict[str, Any]) -> list[Sheet]:
    """Return what was measured in each recording."""
    sheets = []
    for name, one in found.items():
        head = Sheet(f"{name}: {one['kind']}, {one['runtime_s']} s", notes=list(one.get("left_out", ())))
        sheets += [head, *_tables(one)]
    return sheets


def _tables(one: dict[str, Any]) -> list[Sheet]:
    if "odometry" in one:
        halves = [_registration(half) for half in one["halves"] if half["registration"]]
        return [_odometry(one["odometry"]), _localisation(one["halves"]), *halves]
    if "on_apollos_map" in one:
        return [_pair_sheet(one), *(_registration(half) for half in one["halves"]), _apollo(one)]
    if "by" in one:
        return [_nagoya(one)]
    return [_flexmap(one)]


def _odometry(rows: list[dict[str, Any]]) -> Sheet:
    table = sheet(
        "Odometry", "", "way m", "less the positions' m", "from positions 50 / 95 % m",
        "step from ours 95 % m / °", "end from ours along / across m", "ms a scan",
    )  # fmt: skip
    for row in rows:
        if row["absent"]:
            table.add(row["name"], row["absent"])
            continue
        table.add(
            row["name"],
            fixed(row["way_m"], 2),
            fixed(row.get("way_less_positions_m"), 2),
            _pair_of(row, "positions_m_p50", "positions_m_p95", 2),
            _pair_of(row, "step_m_p95", "step_deg_p95", 3),
            _pair_of(row, "end_along_m", "end_across_m", 2),
            fixed(row["ms_per_scan"], 0),
        )
    return table


def _localisation(halves: list[dict[str, Any]]) -> Sheet:
    table = sheet(
        "Localised on the other part: poses called good, 95 % (largest)", "", "submaps", "good / localised / driven",
        "along m", "across m", "heading °", "against",
    )  # fmt: skip
    for half in halves:
        for method, submaps in _METHODS.items():
            one = half[method]
            count = f"{one['health'].get('good', 0)} / {one['localised']} / {half['driven']}"
            for name, error in one["errors"].items():
                table.add(half["name"], submaps, count, *_errors(error), name)
        table.add("", "", "", *_errors(half["gicp_less_track"]), "gicp less track")
    return table


def _errors(error: dict[str, Any] | None) -> list[str]:
    keys = (("longitudinal", "m"), ("lateral", "m"), ("heading", "deg"))
    if error is None:
        return ["-"] * len(keys)
    return [f"{error[f'{key}_p95_{unit}']:.3f} ({error[f'{key}_max_{unit}']:.3f})" for key, unit in keys]


def _registration(half: dict[str, Any]) -> Sheet:
    table = sheet(
        f"Registration, {half['name']}", "from", "method", "converged", "not, and said so", "not, and silent",
        "error 50 % cm / °", "ms",
    )  # fmt: skip
    for row in half["registration"]:
        error = "-" if row["error_m_p50"] is None else f"{100 * row['error_m_p50']:.1f} / {row['error_deg_p50']:.3f}"
        shares = (f"{row[key]:.0%}" for key in ("converged", "not_and_said_so", "not_and_silent"))
        table.add(f"{row['off_m']} m, {row['off_deg']}°", row["method"], *shares, error, fixed(row["ms_p50"], 1))
    return table


def _pair_sheet(one: dict[str, Any]) -> Sheet:
    at = one["place"]
    where = f"{at['lat_deg']:.7f}°, {at['lon_deg']:.7f}°, {at['height_m']:.2f} m"
    title = f"Scan 2 lies at {where}, heading {at['heading_deg']:.2f}°"
    table = sheet(
        title, "searched from 2.5 m, any heading", "sure", "Gaussians", "these off m, m, °", "all off m, m, °"
    )
    for row in one["searches"]:
        count = f"{row['sure']} of {row['searches']}"
        off = (", ".join(_off(row[key])) for key in ("largest_error_sure", "largest_error"))
        table.add(row["name"], count, str(row["gaussians"]), *off)
    return table


def _apollo(one: dict[str, Any]) -> Sheet:
    apart = one["gaussians"]
    shift = ", ".join(f"{100 * value:.1f}" for value in apart["shift_enu_m"])
    table = sheet(
        f"On Apollo's own map ({apart['compared']} Gaussians, {100 * apart['along_normal_m_p50']:.1f} cm apart (50 %),"
        f" shifted by {shift} cm east, north, up)",
        "scan", "from", "within 10 cm", "along m", "across m", "heading °",
    )  # fmt: skip
    for row in one["on_apollos_map"]:
        table.add(str(row["scan"]), f"{row['off_m']} m, {row['off_deg']}°", f"{row['within_10_cm']:.0%}", *_off(row))
    return table


def _off(error: dict[str, Any] | None) -> list[str]:
    keys = ("longitudinal_m", "lateral_m", "heading_deg")
    return ["-"] * len(keys) if error is None else [f"{error[key]:.3f}" for key in keys]


def _nagoya(one: dict[str, Any]) -> Sheet:
    table = sheet(
        f"{one['poses']} poses over {one['way_m']:.0f} m against the reference, 50 / 95 % / largest m",
        "fixes", "number", "the fixes", "track, rigid", "track, bent", "heading °",
    )  # fmt: skip
    for row in one["by"]:
        cells = (_three(row[key]) for key in ("fixes_off_m", "rigid_off_m", "off_m", "heading_deg"))
        table.add(row["name"], str(row["fixes"]), *cells)
    return table


def _flexmap(one: dict[str, Any]) -> Sheet:
    table = sheet(
        f"{one['poses']} poses over {one['way_m']:.0f} m, distance of GNSS from the track, 50 / 95 % / largest m", "",
        "fixes used", "fixes held out", "of these in a lane",
    )  # fmt: skip
    for name in ("rigid", "bent"):
        share = f"{one['held_out_in_lanes'][name]:.1%}"
        table.add(name, _three(one["used_m"][name]), _three(one["held_out_m"][name]), share)
    return table


def _three(values: dict[str, float]) -> str:
    return several(values[key] for key in ("p50", "p95", "max"))


def _pair_of(row: dict[str, Any], first: str, second: str, digits: int) -> str:
    return several((row[first], row[second]), digits) if first in row else "–"


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
