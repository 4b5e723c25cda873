"""GeoJSON (RFC 7946): points with a time each, or a line with times of its coordinates."""

import json
from pathlib import Path
from typing import Any, Final

from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.trajectories.columns import NAMES, table_of_columns
from gnd.vehicle_agent.importers.trajectories.pose_table import PoseTable

LINE_TIMES: Final = ("coordTimes", "coordinateProperties", "times", "timestamps")


def table_of_geojson(path: Path, text: str) -> PoseTable:
    """Poses or positions; heights are above the ellipsoid (RFC 7946, 4).

    Raises:
        ImportDriveError: no JSON, no points or line with times, coordinates without a height.
    """
    try:
        content = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        raise ImportDriveError(f"{path}: no JSON: {error}") from None
    features = content.get("features", [content]) if isinstance(content, dict) else []
    rows: list[dict[str, Any]] = []
    for feature in features:
        geometry, properties = feature.get("geometry") or {}, feature.get("properties") or {}
        if geometry.get("type") == "Point":
            rows.append({**_plain(properties), **_place(path, geometry["coordinates"])})
        if geometry.get("type") == "LineString":
            rows += _line(path, geometry["coordinates"], properties)
    if len(rows) < 2:
        raise ImportDriveError(f"{path}: {len(rows)} points; a trajectory has Points or a LineString, each with a time")
    names = [name for name in rows[0] if all(name in row for row in rows)]
    return table_of_columns(path, names, [[str(row[name]) for name in names] for row in rows])


def _plain(properties: dict[str, Any]) -> dict[str, Any]:
    known = {name for key in NAMES for name in NAMES[key] if key not in ("lat", "lon", "h")}
    return {
        name: value
        for name, value in properties.items()
        if isinstance(value, (int, float, str)) and _stem(name) in known
    }


def _stem(name: str) -> str:
    return "".join(one for one in name.lower().removesuffix("_deg").removesuffix("_rad").removesuffix("_ns")
                   if one.isalpha())  # fmt: skip


def _line(path: Path, places: list[list[float]], properties: dict[str, Any]) -> list[dict[str, Any]]:
    times = next((properties[name] for name in LINE_TIMES if name in properties), None)
    if isinstance(times, dict):
        times = times.get("times")
    if not isinstance(times, list) or len(times) != len(places):
        raise ImportDriveError(f"{path}: a LineString without a time for each place (properties.coordTimes)")
    return [{"time": time, **_place(path, place)} for time, place in zip(times, places, strict=True)]


def _place(path: Path, place: list[float]) -> dict[str, float]:
    if len(place) < 3:
        raise ImportDriveError(f"{path}: coordinates without a height above the ellipsoid")
    return {"longitude": place[0], "latitude": place[1], "height": place[2]}
