"""What a recording holds and what becomes of it, as lines for people and as values for programs."""

from dataclasses import asdict
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from gnd.vehicle_agent.importers.recording import Recording

if TYPE_CHECKING:
    from gnd.vehicle_agent.importer import Imported


def listing(recording: Recording) -> list[str]:
    """A line for each thing in it, with what it is used for."""
    lines = [f"{recording.name}: {len(recording)} scans, {_span(recording)}"]
    wide = max((len(one.name) for one in recording.entries), default=0)
    for one in recording.entries:
        detail = f" [{one.detail}]" if one.detail else ""
        use = f"used: {one.used}" if one.used else f"not used{': ' + one.why if one.why else ''}"
        lines.append(f"  {one.name:<{wide}}  {one.count} x {one.kind}{detail}  {use}")
    where = recording.anchor
    place = f"{where.lat_deg:.6f}, {where.lon_deg:.6f}, {where.height_m:.1f} m" if recording.placed else "not known"
    return [*lines, f"  place: {place}; mount: {recording.mount}; sensor: {recording.sensor_model}"]


def listed(recording: Recording) -> dict[str, Any]:
    """The same as values."""
    where = recording.anchor
    return {
        "recording": recording.name,
        "scans": len(recording),
        "first_ns": int(recording.t_ns[0]),
        "last_ns": int(recording.t_ns[-1]),
        "holds": [asdict(one) for one in recording.entries],
        "place": [where.lat_deg, where.lon_deg, where.height_m] if recording.placed else None,
        "mount": recording.mount,
        "T_vehicle_lidar": recording.T_vehicle_lidar.tolist(),
        "sensor": recording.sensor_model,
    }


def result_of(imported: "Imported") -> dict[str, Any]:
    """What became of it, as values."""
    return {
        "written": imported.scans,
        "quality": imported.quality.as_json() if imported.quality else None,
        "notes": list(imported.notes),
        "passed_over": list(imported.bad),
        "empty_scans": imported.empty_scans,
        "points_not_finite": imported.points_not_finite,
        "points_too_far": imported.points_too_far,
    }


def _span(recording: Recording) -> str:
    seconds = float((recording.t_ns[-1] - recording.t_ns[0]) * 1e-9)
    begin = datetime.fromtimestamp(int(recording.t_ns[0]) // 1_000_000_000, UTC)
    return f"{begin:%Y-%m-%d %H:%M:%S} UTC, {seconds:.1f} s, {(len(recording) - 1) / seconds:.2f} Hz"
