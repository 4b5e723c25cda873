"""The track on the Earth: a table with a row a pose (CSV) and lines by health (GeoJSON); QGIS opens both."""

import json
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.localise.estimates import ErrorSeries, PoseEstimate, error_series
from gnd.vehicle_agent.localise_drive.run import LocalisedDrive, Moment, trajectory_of
from gnd.vehicle_agent.localise_drive.stretches import HealthStretch, stretches_of

COLUMNS: Final = (
    "t_ns", "t_s", "way_m", "latitude_deg", "longitude_deg", "height_m", "heading_deg", "sigma_m", "sigma_deg",
    "matching_ratio", "health", "cause", "degenerate", "longitudinal_m", "lateral_m", "heading_error_deg",
)  # fmt: skip
"""heading_deg: clockwise from north, of the vehicle's x axis. Errors are empty without a reference."""
_AT_ONCE_NS: Final = 500_000_000
_DEGREE_DIGITS: Final = 9
"""Of a degree: 0.1 mm on the ground."""


def csv_text(drive: LocalisedDrive) -> str:
    """A row a refined pose."""
    lat_deg, lon_deg, height_m = positions_deg(drive, drive.refined)
    way_m = np.interp([e.t_ns - drive.start_ns for e in drive.refined], *_ways(drive.moments, drive.start_ns))
    errors = _errors_by_time(error_series(drive.refined, drive.reference))
    lines = [",".join(COLUMNS)]
    for k, estimate in enumerate(drive.refined):
        place = (f"{way_m[k]:.3f}", *_degrees(lat_deg[k], lon_deg[k]), f"{height_m[k]:.4f}")
        lines.append(
            ",".join([*_time(estimate, drive), *place, *_state(estimate), *errors.get(estimate.t_ns, ("",) * 3)])
        )
    return "".join(f"{line}\n" for line in lines)


def geojson_text(drive: LocalisedDrive) -> str:
    """A line a stretch of health with poses, and a point where a stretch without poses begins (from GNSS)."""
    features = [_feature(drive, stretch) for stretch in stretches_of(drive.moments)]
    return json.dumps({"type": "FeatureCollection", "features": [f for f in features if f is not None]}) + "\n"


def positions_deg(drive: LocalisedDrive, estimates: Sequence[PoseEstimate]) -> tuple[F64, F64, F64]:
    """Latitude and longitude in degrees and ellipsoidal height in metres of the poses, (N,) each."""
    lat, lon, height = drive.header.anchor.geodetic_from_enu(trajectory_of(estimates).T_dst_vehicle[:, :3, 3])
    return np.degrees(lat), np.degrees(lon), height


def _feature(drive: LocalisedDrive, stretch: HealthStretch) -> dict[str, Any] | None:
    """The line reaches the next stretch's first pose, so that the lines meet."""
    places = list(_places(drive, _poses_of(drive, stretch))) if stretch.health != "lost" else []
    if len(places) >= 2:
        return _geojson(stretch, "LineString", places)
    fixes = drive.gnss.t_ns
    if not len(fixes):
        return None
    k = int(np.argmin(np.abs(fixes - stretch.first_ns)))
    lon_deg, lat_deg = np.degrees(drive.gnss.lon_rad[k]), np.degrees(drive.gnss.lat_rad[k])
    return _geojson(stretch, "Point", [round(float(lon_deg), 9), round(float(lat_deg), 9)])


def _poses_of(drive: LocalisedDrive, stretch: HealthStretch) -> Sequence[PoseEstimate]:
    """The refined poses of a stretch, and the one after if it follows at once."""
    t_ns = trajectory_of(drive.refined).t_ns
    last_ns = drive.start_ns + round(stretch.to_s * 1e9)
    first, end = (int(k) for k in np.searchsorted(t_ns, [stretch.first_ns, last_ns]))
    follows = end < len(t_ns) and t_ns[end] - last_ns < _AT_ONCE_NS
    return drive.refined[first : end + follows]


def _geojson(stretch: HealthStretch, kind: str, coordinates: list[Any]) -> dict[str, Any]:
    return {
        "type": "Feature",
        "geometry": {"type": kind, "coordinates": coordinates},
        "properties": stretch.as_json(),
    }


def _places(drive: LocalisedDrive, poses: Sequence[PoseEstimate]) -> Iterator[list[float]]:
    """Longitude, latitude, height: GeoJSON's order."""
    for lat, lon, height in zip(*positions_deg(drive, poses), strict=True):
        yield [round(float(lon), _DEGREE_DIGITS), round(float(lat), _DEGREE_DIGITS), round(float(height), 4)]


def _ways(moments: Sequence[Moment], start_ns: int) -> tuple[list[int], list[float]]:
    """Times after the start and ways to interpolate between; one zero at least."""
    return [m.t_ns - start_ns for m in moments] or [0], [m.way_m for m in moments] or [0.0]


def _time(estimate: PoseEstimate, drive: LocalisedDrive) -> tuple[str, str]:
    return str(estimate.t_ns), f"{(estimate.t_ns - drive.start_ns) * 1e-9:.3f}"


def _degrees(lat_deg: float, lon_deg: float) -> tuple[str, str]:
    return f"{lat_deg:.{_DEGREE_DIGITS}f}", f"{lon_deg:.{_DEGREE_DIGITS}f}"


def _state(estimate: PoseEstimate) -> tuple[str, ...]:
    T = estimate.T_map_vehicle
    heading_deg = float(np.degrees(np.arctan2(T[0, 0], T[1, 0]))) % 360.0
    numbers = (f"{heading_deg:.5f}", f"{estimate.sigma_m:.5f}", f"{np.degrees(estimate.sigma_rad):.5f}")
    ratio = f"{estimate.matching_ratio:.4f}"
    return *numbers, ratio, estimate.health, estimate.cause, " ".join(estimate.degenerate)


def _errors_by_time(series: ErrorSeries) -> dict[int, tuple[str, str, str]]:
    rows = zip(series.t_ns, series.longitudinal, series.lateral, series.heading, strict=True)
    return {int(t): (f"{a:.5f}", f"{b:.5f}", f"{c:.5f}") for t, a, b, c in rows}
