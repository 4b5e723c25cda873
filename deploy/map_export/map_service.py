"""Autoware's services of maps over rmw_zenoh: its NDT localiser gets the cells around it, and what has changed.

| service | type, of autoware_map_msgs/srv | |
|---|---|---|
| /map/get_differential_pointcloud_map | GetDifferentialPointCloudMap | the cells of an area that a client lacks |
| /map/get_partial_pointcloud_map | GetPartialPointCloudMap | all cells of an area |

Autoware's localiser waits without end for the answer to a request (map_update_module.cpp), and an error of zenoh is no
answer to it: only what is no request at all gets one. An area that is none gets the answer that nothing changes.
"""

import logging
import time
from typing import Final

from gnd.deploy.map_export.autoware_messages import (
    MapRequest,
    answer_message,
    differential_service,
    partial_service,
    read_request,
)
from gnd.deploy.map_export.differential import Area
from gnd.deploy.map_export.served_map import CELL_HEAD_BYTES, CellsToLoad, ServedMap
from gnd.fleet_bus.config import MAX_MESSAGE_BYTES
from gnd.fleet_bus.errors import Refused
from gnd.fleet_bus.ros2 import RosNode, RosTopic
from gnd.fleet_bus.ros2_service import RosService
from gnd.tile_store.export import ExportError
from gnd.vehicle_agent.sources.ros2_messages import BadRosMessage
from gnd.vehicle_agent.sources.ros2_services import RosServiceType

NAMESPACE: Final = "/map"
"""Where Autoware's launch files look for the services."""
DIFFERENTIAL: Final = "get_differential_pointcloud_map"
PARTIAL: Final = "get_partial_pointcloud_map"
MOST_BYTES: Final = MAX_MESSAGE_BYTES - 65_536
"""Of an answer; the rest is for what zenoh puts around it."""
_ID_BYTES: Final = 8  # length and end of a text in CDR, aligned
_NOTHING: Final = CellsToLoad({}, (), 0)
_log = logging.getLogger(__name__)


class MapService:
    """Answers from a map, on a node.

    Args:
        node: of which the services are.
        served: the map.
        namespace: of the services.
        limit_bytes: the largest answer; of cells that do not fit, the farthest are left for the next request.
    """

    def __init__(
        self, node: RosNode, served: ServedMap, namespace: str = NAMESPACE, limit_bytes: int = MOST_BYTES
    ) -> None:
        self._served, self._limit_bytes = served, limit_bytes
        self._parts: tuple[RosService, ...] = (
            self._serve(node, f"{namespace}/{DIFFERENTIAL}", differential_service()),
            self._serve(node, f"{namespace}/{PARTIAL}", partial_service()),
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the services."""
        return tuple(part.name for part in self._parts)

    @property
    def answered(self) -> int:
        """How many requests got an answer."""
        return sum(part.answered for part in self._parts)

    @property
    def refused(self) -> int:
        """How many got an error."""
        return sum(part.refused for part in self._parts)

    def _serve(self, node: RosNode, name: str, service: RosServiceType) -> RosService:
        topic = RosTopic(name, service.name, service.type_hash)
        return node.serve(topic, lambda cdr: self._answer(service, cdr))

    def _answer(self, service: RosServiceType, cdr: bytes) -> bytes:
        try:
            request = read_request(service, cdr)
        except BadRosMessage as error:
            raise Refused(str(error)) from error
        found, partial = self._found(request), service == partial_service()
        if found.left:
            rest = "ask for a smaller area" if partial else "the next request gets them"
            _log.warning("%d cells more than %d bytes can hold: %s", found.left, self._limit_bytes, rest)
        removed = {} if partial else {"ids_to_remove": list(found.ids_to_remove)}
        return answer_message(service, time.time_ns(), found.new, **removed)

    def _found(self, request: MapRequest) -> CellsToLoad:
        """What the client gets; nothing changes where it asks for no area."""
        try:
            area = Area(request.center_x, request.center_y, request.radius)
        except ExportError as error:
            _log.warning("answered with nothing: %s", error)
            return _NOTHING
        ids_bytes = sum(len(name.encode()) + _ID_BYTES for name in request.cached_ids)
        left_bytes = self._limit_bytes - CELL_HEAD_BYTES - ids_bytes
        return self._served.cells_for(area, request.cached_ids, left_bytes)
