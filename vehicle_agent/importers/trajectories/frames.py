"""Poses of a file in the frame `map`: ENU at an anchor."""

import re
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.errors import GeodesyError
from gnd.gnd_map.geodesy import LocalFrame, ecef_from_geodetic, enu_axes
from gnd.gnd_map.se3 import T_from_R_t, T_inverse, exp_so3
from gnd.gnd_map.utm import convergence_rad, geodetic_from_utm
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.recording import RecordingAnchor
from gnd.vehicle_agent.importers.trajectories.pose_table import PoseTable

F64 = NDArray[np.float64]

FRAMES: Final = "auto, local, ecef, geodetic, utm:ZONE (such as utm:33 or utm:56S)"
FAR_M: Final = 200_000.0
R_CAMERA_BODY: Final = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""A body's forward, left, up in a camera's axes: right, down, forward."""


def with_frame(table: PoseTable, frame: str, near: RecordingAnchor | None) -> tuple[PoseTable, int, bool]:
    """The table with the frame that was chosen, its UTM zone (0: none) and whether that is a southern one.

    near: some place of the recording, from its GNSS or the anchor: tells the zone of UTM coordinates.

    Raises:
        ImportDriveError: an unknown frame, a zone that is missing, coordinates that cannot be of the frame.
    """
    found = re.fullmatch(r"utm:(\d{1,2})([NS]?)", frame, re.IGNORECASE)
    if found:
        if not 1 <= int(found[1]) <= 60:
            raise ImportDriveError(f"--poses-frame {frame}: UTM zones are 1 ... 60")
        return replace(table, coordinates="utm"), int(found[1]), found[2].upper() == "S"
    if frame in ("local", "ecef"):
        return replace(table, coordinates=frame), 0, False  # type: ignore[arg-type]
    if frame == "geodetic" and table.coordinates != "geodetic":
        raise ImportDriveError(f"{table.source}: no latitude and longitude in it")
    if frame not in ("auto", "geodetic"):
        raise ImportDriveError(f"--poses-frame {frame!r}: expected {FRAMES}")
    if table.coordinates != "utm":
        return table, 0, False
    if near is None:
        raise ImportDriveError(
            f"{table.source}: positions such as {table.p[0, 0]:.0f}, {table.p[0, 1]:.0f} look like UTM: give"
            " --poses-frame utm:ZONE, such as utm:33 or utm:56S; or --poses-frame local"
        )
    zone = int((near.lon_deg + 180.0) // 6.0) % 60 + 1
    note = f"{table.source}: taken as UTM zone {zone}{'S' if near.lat_deg < 0 else 'N'}"
    return replace(table, notes=(*table.notes, note)), zone, near.lat_deg < 0


def ecef_poses(table: PoseTable, zone: int, southern: bool, anchor: RecordingAnchor | None) -> tuple[F64, F64]:
    """(N, 3) positions and (N, 3, 3) rotations (east-north-up where the file gives none) in ECEF.

    anchor: origin and heading of a local frame.

    Raises:
        ImportDriveError: a local frame without an anchor, or coordinates that are no place on the Earth.
    """
    R = np.tile(np.eye(3), (len(table), 1, 1)) if table.R is None else table.R
    try:
        if table.coordinates == "ecef":
            return table.p, R
        if table.coordinates == "local":
            return _of_local(table, R, anchor)
        lat, lon, turn = table.p[:, 0], table.p[:, 1], np.zeros(len(table))
        if table.coordinates == "utm":
            lat, lon = geodetic_from_utm(table.p[:, 0], table.p[:, 1], zone, southern=southern)
            turn = -convergence_rad(lat, lon, zone)  # anticlockwise from east, an azimuth is clockwise from north
        level = exp_so3(np.column_stack([np.zeros((len(turn), 2)), turn]))
        return ecef_from_geodetic(lat, lon, table.p[:, 2]), enu_axes(lat, lon) @ level @ R
    except GeodesyError as error:
        raise ImportDriveError(f"{table.source}: {error}") from error


def _of_local(table: PoseTable, R: F64, anchor: RecordingAnchor | None) -> tuple[F64, F64]:
    if anchor is None:
        raise ImportDriveError(
            f"{table.source}: poses in a local frame: --anchor LAT,LON,HEIGHT,HEADING says where its origin lies and"
            " where its x axis points"
        )
    size = float(np.abs(table.p).max())
    if size > FAR_M:
        raise ImportDriveError(
            f"{table.source}: poses up to {size / 1000:.0f} km from the origin of a local frame: give --poses-frame"
        )
    frame, turn = anchor.frame, anchor.T_map_start[:3, :3]
    return frame.ecef_from_enu(table.p @ turn.T), frame.R_ecef_enu @ turn @ R


def in_map(p_ecef: F64, R_ecef: F64, frame: LocalFrame) -> F64:
    """(N, 4, 4) poses T_map_body of positions (N, 3) and rotations (N, 3, 3) in ECEF."""
    return T_from_R_t(frame.R_ecef_enu.T @ R_ecef, frame.enu_from_ecef(p_ecef))


def without_camera(table: PoseTable, T_camera_lidar: F64 | None) -> PoseTable:
    """Poses of a camera in its own axes as poses of the LiDAR (x forward) in the frame of its first axes, level.

    T_camera_lidar: (4, 4) calibration; None: the LiDAR is taken to sit at the camera.
    """
    assert table.R is not None
    T_camera_body = T_from_R_t(R_CAMERA_BODY, np.zeros(3)) if T_camera_lidar is None else T_camera_lidar
    T = T_inverse(T_camera_body) @ T_from_R_t(table.R, table.p) @ T_camera_body
    how = "at the LiDAR's place: no calibration" if T_camera_lidar is None else "calibrated against the LiDAR"
    note = f"{table.source}: poses of a camera (it moves along its z), {how}"
    return replace(table, p=T[:, :3, 3].copy(), R=T[:, :3, :3].copy(), camera=False, notes=(*table.notes, note))
