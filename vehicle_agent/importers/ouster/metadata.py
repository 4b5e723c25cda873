"""Metadata of an Ouster sensor: the JSON that its driver or `ouster-cli` writes beside a capture.

Read are the flat form (firmware to 2.x: every key at the top, `data_format`) and the nested one (`sensor_info`,
`beam_intrinsics`, `lidar_intrinsics`, `lidar_data_format`, `config_params`). Angles are degrees, lengths mm.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.bounded import json_value
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.ouster.packets import PROFILES, LidarProfile

F64 = NDArray[np.float64]

MAX_BYTES: Final = 10 << 20
MAX_BEAMS: Final = 1024
MAX_COLUMNS: Final = 8192
"""Sensors have 128 beams and 4096 columns at most; tables are made for each beam of each column."""
ROUNDED: Final = 1e-3
"""Rotations with three decimals are rotations."""
_GROUPS: Final = (
    "sensor_info", "beam_intrinsics", "lidar_intrinsics", "lidar_data_format", "data_format", "config_params",
    "ouster-sdk",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class OusterMetadata:
    """What a sensor says of itself.

    altitude_rad, azimuth_rad: (B,) of the beams, up and counter-clockwise. T_lidar_beam, T_sensor_lidar: (4, 4),
    lengths in mm. columns: of a full turn; window: first and last that is measured, both within. timestamp_mode: the
    clock of the columns; empty: not said. extrinsic: somebody has put a pose of the sensor into the file.
    """

    path: Path
    product: str
    serial: int
    profile: LidarProfile
    columns: int
    columns_per_packet: int
    window: tuple[int, int]
    altitude_rad: F64
    azimuth_rad: F64
    T_lidar_beam: F64
    T_sensor_lidar: F64
    port_lidar: int
    port_imu: int
    timestamp_mode: str
    extrinsic: bool

    def __post_init__(self) -> None:
        if not 0 < self.n_beams == len(self.azimuth_rad) <= MAX_BEAMS:
            raise ImportDriveError(
                f"{self.path}: {self.n_beams} altitudes and {len(self.azimuth_rad)} azimuths (1 ... {MAX_BEAMS})"
            )
        fits = 0 < self.columns <= MAX_COLUMNS and 0 < self.columns_per_packet <= MAX_COLUMNS
        if not fits or not all(0 <= one < self.columns for one in self.window):
            raise ImportDriveError(
                f"{self.path}: {self.columns} columns a frame, {self.columns_per_packet} a packet, window {self.window}"
            )
        for T in (self.T_lidar_beam, self.T_sensor_lidar):
            R = np.clip(T[:3, :3], -2.0, 2.0)  # products of huge numbers overflow
            if not np.isfinite(T).all() or np.abs(R @ R.T - np.eye(3)).max() > ROUNDED:
                raise ImportDriveError(f"{self.path}: a transform that is no rigid 4x4 matrix: {T.tolist()}")

    @property
    def n_beams(self) -> int:
        """Beams of a column."""
        return len(self.altitude_rad)

    @property
    def packet_bytes(self) -> int:
        """Length of a lidar packet."""
        return self.profile.packet_bytes(self.n_beams, self.columns_per_packet)

    @property
    def measured(self) -> NDArray[np.int64]:
        """(M,) measurement numbers in the window, which may go over the end of the turn."""
        first, last = self.window
        return (first + np.arange((last - first) % self.columns + 1)) % self.columns


def is_metadata(path: Path) -> bool:
    """Whether a JSON is of an Ouster sensor, by what is in it."""
    try:
        return path.stat().st_size <= MAX_BYTES and b"beam_altitude_angles" in path.read_bytes()
    except OSError:
        return False


def read_metadata(path: Path) -> OusterMetadata:
    """The metadata of a file.

    Raises:
        ImportDriveError: no such JSON, a key is missing, or a profile that is not known.
    """
    try:
        content = json_value(path.read_bytes())
    except (OSError, ValueError) as error:
        raise ImportDriveError(f"{path}: no readable JSON: {error}") from error
    if not isinstance(content, dict):
        raise ImportDriveError(f"{path}: no metadata of a sensor")
    groups = [content, *(content[name] for name in _GROUPS if isinstance(content.get(name), dict))]
    values = {key: value for group in reversed(groups) for key, value in group.items()}
    try:
        return _metadata(path, values)
    except KeyError as error:
        raise ImportDriveError(f"{path}: metadata of a sensor without {error.args[0]!r}") from error
    except (TypeError, ValueError, OverflowError) as error:
        raise ImportDriveError(f"{path}: metadata of a sensor: {' '.join(str(error).split())[:200]}") from error


def _metadata(path: Path, values: dict[str, Any]) -> OusterMetadata:
    angles = [np.radians(np.array(values[f"beam_{name}_angles"], np.float64)) for name in ("altitude", "azimuth")]
    columns = int(values.get("columns_per_frame") or values["lidar_mode"].split("x")[0])
    first, last = values.get("column_window", (0, columns - 1))
    return OusterMetadata(
        path=path,
        product=str(values.get("prod_line", "")) or f"OS-{len(angles[0])}",
        serial=int("".join(re.findall(r"\d", str(values.get("prod_sn", ""))))[-15:] or 0),
        profile=_profile(path, values),
        columns=columns,
        columns_per_packet=int(values.get("columns_per_packet", 16)),
        window=(int(first), int(last)),
        altitude_rad=angles[0],
        azimuth_rad=angles[1],
        T_lidar_beam=_beam(values),
        T_sensor_lidar=np.array(values["lidar_to_sensor_transform"], np.float64).reshape(4, 4),
        port_lidar=int(values.get("udp_port_lidar") or 0),
        port_imu=int(values.get("udp_port_imu") or 0),
        timestamp_mode=str(values.get("timestamp_mode", "")),
        extrinsic=bool(np.abs(np.array(values.get("extrinsic", np.eye(4).ravel())).ravel() - np.eye(4).ravel()).any()),
    )


def _profile(path: Path, values: dict[str, Any]) -> LidarProfile:
    """A sensor that does not say a profile is from before there were any."""
    name = str(values.get("udp_profile_lidar", "LEGACY"))
    if name not in PROFILES:
        raise ImportDriveError(f"{path}: lidar profile {name!r} is not read; known are {', '.join(PROFILES)}")
    profile = PROFILES[name]
    wide = profile.wide or (values.get("header_type") == "FUSA" and not profile.legacy)
    return replace(profile, wide=wide)


def _beam(values: dict[str, Any]) -> F64:
    """Where the beams begin against the axis of turning, mm."""
    if "beam_to_lidar_transform" in values:
        return np.array(values["beam_to_lidar_transform"], np.float64).reshape(4, 4)
    T = np.eye(4)
    T[0, 3] = float(values["lidar_origin_to_beam_origin_mm"])
    return T
