"""Points of Ouster's ranges.

Source: Ouster Firmware User Manual, "Lidar Range to XYZ": the beam turns on a circle about the axis, and the range
counts from the axis along the beam. Axes: the sensor's (x to the front, z up), origin at its base.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gnd.schemas.drive import U32
from gnd.vehicle_agent.importers.ouster.metadata import OusterMetadata

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class PointTable:
    """direction: (W, B, 3) of each column's beams. offset_m: (W, B, 3), so that p = range * direction + offset."""

    direction: F64
    offset_m: F64

    @classmethod
    def of(cls, metadata: OusterMetadata) -> "PointTable":
        """Both for every column of a turn."""
        encoder = 2.0 * np.pi * (1.0 - np.arange(metadata.columns) / metadata.columns)[:, None]
        azimuth, altitude = encoder - metadata.azimuth_rad, metadata.altitude_rad
        shape = azimuth.shape
        flat = np.cos(altitude)
        beam = np.stack(
            [np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.broadcast_to(np.sin(altitude), shape)], axis=-1
        )
        forward, up = metadata.T_lidar_beam[0, 3], metadata.T_lidar_beam[2, 3]
        circle = np.stack([forward * np.cos(encoder), forward * np.sin(encoder), np.full_like(encoder, up)], axis=-1)
        R, t = metadata.T_sensor_lidar[:3, :3], metadata.T_sensor_lidar[:3, 3]
        return cls(beam @ R.T, 1e-3 * ((circle - np.hypot(forward, up) * beam) @ R.T + t))

    def points_m(self, measurement_id: NDArray[np.int64], range_mm: U32) -> F64:
        """(N, B, 3) of N columns; where a range is 0 there is no point."""
        return 1e-3 * range_mm[..., None] * self.direction[measurement_id] + self.offset_m[measurement_id]
