"""The result as tables."""

from typing import Any

from studies.frame.tables import Sheet, fixed, several, sheet

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
        return [_pair(one), *(_registration(half) for half in one["halves"]), _apollo(one)]
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


def _pair(one: dict[str, Any]) -> Sheet:
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
