"""The results of a localised drive, as plain values and as tables for people."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from rich.console import Console
from rich.table import Table

from gnd.vehicle_agent.localise.consistency import nees_of
from gnd.vehicle_agent.localise.estimates import PoseEstimate, error_series
from gnd.vehicle_agent.localise_drive.accuracy import LIMITS, error_summary, healthy, limits_json
from gnd.vehicle_agent.localise_drive.run import LocalisedDrive
from gnd.vehicle_agent.localise_drive.stretches import HealthStretch, health_shares, stretches_of

SHOWN_STRETCHES: Final = 30
STYLES: Final = {"good": "green", "degraded": "yellow", "lost": "red"}


def summary(drive: LocalisedDrive) -> dict[str, Any]:
    """Everything but the poses: what `--json` gives."""
    counts, stretches = drive.counts, stretches_of(drive.moments)
    return {
        "drive_id": drive.header.drive_id,
        "vehicle": drive.header.vehicle,
        "sensor_model": drive.header.sensor_model,
        "finished": counts.finished,
        "damage": counts.damage,
        "scans": counts.scans,
        "scans_bad": counts.bad,
        "scans_dropped": counts.dropped,
        "scans_localised": len(drive.refined),
        "localised_share": round(len(drive.refined) / max(counts.scans, 1), 4),
        "duration_s": round(stretches[-1].to_s, 3) if stretches else 0.0,
        "way_m": round(drive.moments[-1].way_m, 2) if drive.moments else 0.0,
        "initialisation_s": _initialisation_s(drive),
        "initialisations": counts.initialisations,
        "speed_scale": round(counts.speed_scale, 5),
        "yaw_bias_degps": round(float(np.degrees(counts.yaw_bias_radps)), 5),
        "calibration": None if counts.calibration is None else counts.calibration.as_json(),
        "sigma": _sigma(drive.refined),
        "nis": None if counts.nis is None else round(counts.nis, 3),
        "nees": _nees(drive),
        "points_travelling_along": counts.points_travelling_along,
        "errors": _errors(drive),
        "health": health_shares(stretches),
        "tiles_used": {tile_id.path: version for tile_id, version in sorted(drive.used.items())},
        "tiles_absent": len(drive.absent),
        "wall_s": round(counts.wall_s, 2),
    }


def health_json(drive: LocalisedDrive) -> dict[str, Any]:
    """The health timeline."""
    stretches = stretches_of(drive.moments)
    return {
        "start_ns": drive.start_ns,
        "shares": health_shares(stretches),
        "stretches": [stretch.as_json() for stretch in stretches],
    }


def _initialisation_s(drive: LocalisedDrive) -> float | None:
    """From the first scan until the first that has a pose; None when none has."""
    first = next((moment for moment in drive.moments if moment.health != "lost"), None)
    return None if first is None else round((first.t_ns - drive.start_ns) * 1e-9, 3)


def _sigma(estimates: Sequence[PoseEstimate]) -> dict[str, float] | None:
    """The localiser's own uncertainty: median and largest one-sigma."""
    if not estimates:
        return None
    m, deg = np.array([(e.sigma_m, np.degrees(e.sigma_rad)) for e in estimates]).T
    columns = {"median_m": np.median(m), "max_m": m.max(), "median_deg": np.median(deg), "max_deg": deg.max()}
    return {name: round(float(value), 5) for name, value in columns.items()}


def _nees(drive: LocalisedDrive) -> dict[str, Any] | None:
    """Of the refined and the online poses called good; None without a reference."""
    if drive.reference is None:
        return None
    kinds = {"refined": healthy(drive.refined), "online": healthy(drive.online)}
    found = {name: nees_of(poses, drive.reference) for name, poses in kinds.items()}
    return {name: None if nees is None else nees.as_json() for name, nees in found.items()}


def _errors(drive: LocalisedDrive) -> dict[str, Any] | None:
    """Of the refined and the online poses, all and those called good; None without a reference."""
    if drive.reference is None:
        return None
    kinds = {
        "refined": drive.refined,
        "refined_good": healthy(drive.refined),
        "online": drive.online,
        "online_good": healthy(drive.online),
    }
    found = {name: error_summary(error_series(poses, drive.reference)) for name, poses in kinds.items()}
    return found | {"limits": limits_json()}


def print_account(console: Console, values: dict[str, Any], stretches: Sequence[HealthStretch]) -> None:
    """Print the drive in numbers, its errors and its health."""
    console.print(_fields(values))
    if values["errors"] is not None:
        console.print(_error_table(values["errors"]))
    console.print(_health_table(stretches))
    if len(stretches) > SHOWN_STRETCHES:
        console.print(f"... and {len(stretches) - SHOWN_STRETCHES} more stretches in health.json")


def _fields(values: dict[str, Any]) -> Table:
    table = _table(f"{values['drive_id']}, {values['sensor_model']}", "", "")
    bad = ", ".join(f"{n} {state}" for state, n in values["scans_bad"].items()) or "none"
    began = values["initialisation_s"]
    sigma = values["sigma"]
    rows = (
        ("scans", f"{values['scans']} on {values['way_m']:.0f} m in {values['duration_s']:.1f} s"),
        ("localised", f"{values['scans_localised']}, {values['localised_share']:.1%}"),
        ("without pose", f"{values['scans_dropped']}; unusable: {bad}"),
        ("first pose after", "never" if began is None else f"{began:.1f} s; {values['initialisations']} found in all"),
        ("learnt", f"speed x {values['speed_scale']:.4f}, yaw rate {-values['yaw_bias_degps']:+.3f} °/s"),
        *_calibration(values["calibration"]),
        ("own estimate of error", "none" if sigma is None else
            f"{sigma['median_m'] * 100:.1f} cm, {sigma['median_deg']:.3f}° (one sigma, median)"),
        ("errors against their sigmas", _consistency(values)),
        ("tiles", f"{len(values['tiles_used'])} used; {values['tiles_absent']} nearby are not in the map"),
        ("time", f"{values['wall_s']:.1f} s, {values['wall_s'] / max(values['scans'], 1) * 1000:.1f} ms a scan"),
    )  # fmt: skip
    for row in rows:
        table.add_row(*row)
    return table


def _consistency(values: dict[str, Any]) -> str:
    """NIS, and NEES where there is a reference: 1 is honest, more is too sure."""
    parts = [] if values["nis"] is None else [f"NIS {values['nis']:.2f}"]
    for name, nees in (values["nees"] or {}).items():
        if nees is not None:
            parts.append(f"NEES {name} place {nees['place']:.2f}, heading {nees['heading']:.2f}")
    return "; ".join(parts) or "not known"


def _calibration(values: dict[str, Any] | None) -> tuple[tuple[str, str], ...]:
    """Rows of clock and mount."""
    if values is None:
        return ()
    return ("clock", _clock(values)), ("mount", _mount_used(values)), ("mount against the header", _mount(values))


def _clock(values: dict[str, Any]) -> str:
    """The time offset between LiDAR and motion."""
    offset, doubt = values["time_offset_s"], values["clock_doubt"]
    text = f"wheels and gyro {offset['value'] * 1e3:+.1f} ms against the LiDAR, ±{offset['sigma'] * 1e3:.1f}"
    return text if doubt == "none" else f"{text}; {doubt}"


def _mount_used(values: dict[str, Any]) -> str:
    """The mount of the header, and the one that is used where that is another."""
    header, used = values["mount_told"], values["mount_used"]
    form = "LiDAR {height_m:.2f} m above the road, roll {roll_deg:.2f}°, pitch {pitch_deg:.2f}°, yaw {yaw_deg:.2f}°"
    by_header, in_use = form.format(**header), form.format(**used)
    return f"{by_header}, as in the header" if header == used else f"{in_use}; header: {by_header}"


def _mount(values: dict[str, Any]) -> str:
    """What the mount is off by, as far as it was seen."""
    parts = (("height", "mount_height_m", 100.0, " cm"), ("roll", "mount_roll_deg", 1.0, "°"),
             ("pitch", "mount_pitch_deg", 1.0, "°"), ("yaw", "mount_yaw_deg", 1.0, "°"))  # fmt: skip
    known = [
        f"{name} {values[key]['value'] * factor:+.2f}{unit} ±{values[key]['sigma'] * factor:.2f}"
        for name, key, factor, unit in parts
        if values[key] is not None
    ]
    doubtful = ", ".join(values["mount_doubtful"])
    return "; ".join(known) + (f"; wrong in the header: {doubtful}" if doubtful else "")


def _error_table(errors: dict[str, Any]) -> Table:
    table = _table("errors against the reference", "", "95 %", "largest", "limits", "")
    for kind in ("refined", "online"):
        _add_errors(table, kind, errors[kind])
        if errors[f"{kind}_good"] != errors[kind]:
            _add_errors(table, f"{kind} and good", errors[f"{kind}_good"])
    return table


def _add_errors(table: Table, kind: str, errors: dict[str, Any] | None) -> None:
    """Three rows; none without errors."""
    if errors is not None:
        for name, limit in LIMITS.items():
            table.add_row(f"{kind}, {name}", *_error_row(errors[f"{name}_{limit.unit}"], name))


def _error_row(found: dict[str, Any], name: str) -> tuple[str, ...]:
    limit = LIMITS[name]
    scale, unit = (100.0, " cm") if limit.unit == "m" else (1.0, "°")
    digits = 1 if limit.unit == "m" else 3
    p95, largest = (f"{found[key] * scale:.{digits}f}{unit}" for key in ("p95", "max"))
    verdict = "[green]kept[/]" if found["within_limits"] else "[red]exceeded[/]"
    return p95, largest, f"{limit.p95 * scale:g} / {limit.largest * scale:g}{unit}", verdict


def _health_table(stretches: Sequence[HealthStretch]) -> Table:
    table = _table("health", "", "cause", "from", "to", "from", "to", "scans")
    for one in stretches[:SHOWN_STRETCHES]:
        health = f"[{STYLES[one.health]}]{one.health}[/]"
        cause = "" if one.cause == "none" else one.cause.replace("_", " ")
        times, way = (f"{t:.1f} s" for t in (one.from_s, one.to_s)), (f"{m:.0f} m" for m in (one.from_m, one.to_m))
        table.add_row(health, cause, *times, *way, str(one.scans))
    return table


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", box=None, pad_edge=False, show_header=any(columns))
    for number, column in enumerate(columns):
        words = number == 0 or column in ("cause", "limits") or not any(columns)
        table.add_column(column, justify="left" if words else "right", no_wrap=not words)
    return table
