"""Autoware's services of maps as messages: autoware_map_msgs of 2024 and later (autoware_msgs 1.x)."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np

from gnd.deploy.map_export.autoware import CELL_M, CloudCell
from gnd.vehicle_agent.sources.ros2_messages import CLOUD, cloud_values, decode, encode, header
from gnd.vehicle_agent.sources.ros2_services import RosServiceType, service_type

MAP_FRAME: Final = "map"
_PACKAGE: Final = "autoware_map_msgs"
_MESSAGES: Final = {
    f"{_PACKAGE}/msg/AreaInfo": "float32 center_x\nfloat32 center_y\nfloat32 radius\n",
    f"{_PACKAGE}/msg/PointCloudMapCellMetaData": "float32 min_x\nfloat32 min_y\nfloat32 max_x\nfloat32 max_y\n",
    f"{_PACKAGE}/msg/PointCloudMapCellWithID": (
        f"string cell_id\n{CLOUD.replace('/msg/', '/')} pointcloud\nPointCloudMapCellMetaData metadata\n"
    ),
}
_ANSWER: Final = "std_msgs/Header header\nPointCloudMapCellWithID[] new_pointcloud_with_ids\n"


@cache
def differential_service() -> RosServiceType:
    """GetDifferentialPointCloudMap: the cells of an area that a client lacks."""
    definition = f"AreaInfo area\nstring[] cached_ids\n---\n{_ANSWER}string[] ids_to_remove\n"
    return service_type(f"{_PACKAGE}/srv/GetDifferentialPointCloudMap", definition, _MESSAGES)


@cache
def partial_service() -> RosServiceType:
    """GetPartialPointCloudMap: all cells of an area."""
    return service_type(f"{_PACKAGE}/srv/GetPartialPointCloudMap", f"AreaInfo area\n---\n{_ANSWER}", _MESSAGES)


@dataclass(frozen=True, slots=True)
class MapRequest:
    """What a client asks for; the values of its area are not checked.

    Attributes:
        center_x: of the area, m in the frame of the map.
        center_y: the same.
        radius: of the area, m.
        cached_ids: the cells that it has.
    """

    center_x: float
    center_y: float
    radius: float
    cached_ids: tuple[str, ...]


def read_request(service: RosServiceType, cdr: bytes) -> MapRequest:
    """A request; BadRosMessage: bytes of something else."""
    read = decode(service.request, cdr)
    area = read.area
    return MapRequest(area.center_x, area.center_y, area.radius, tuple(getattr(read, "cached_ids", ())))


def answer_message(service: RosServiceType, t_ns: int, cells: Mapping[str, CloudCell], **more: Any) -> bytes:
    """An answer.

    Args:
        service: which.
        t_ns: when it is made.
        cells: that the client gets, by id.
        more: further fields of the answer.
    """
    found = [
        {
            "cell_id": name,
            "pointcloud": cloud_values(t_ns, MAP_FRAME, _packed(cell)),
            "metadata": _bounds(cell.corner),
        }
        for name, cell in cells.items()
    ]
    return encode(service.response, {"header": header(t_ns, MAP_FRAME), "new_pointcloud_with_ids": found} | more)


def _packed(cell: CloudCell) -> np.ndarray[Any, np.dtype[np.void]]:
    return np.ascontiguousarray(cell.cloud, "<f4").view([(name, "<f4") for name in "xyz"]).ravel()


def _bounds(corner: tuple[int, int]) -> dict[str, float]:
    x, y = map(float, corner)
    return {"min_x": x, "min_y": y, "max_x": x + CELL_M, "max_y": y + CELL_M}
