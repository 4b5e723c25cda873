"""Types of services of ROS 2: their messages for CDR, and the hash by which rmw_zenoh keys them.

The hash is that of the service's type description (REP 2016): a type of three fields, request, response and event. The
event, which only introspection sends, holds up to one of each behind a `service_msgs/msg/ServiceEventInfo`. Source:
rosidl_generator_type_description.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from gnd.vehicle_agent.importers.optional import library
from gnd.vehicle_agent.sources.ros2_messages import type_store

EVENT_INFO: Final = "service_msgs/msg/ServiceEventInfo"
# `char` of a .msg file is uint8 in a type description; rosbags' own definition keeps it, and so has another hash.
_EVENT_INFO_TEXT: Final = (
    "uint8 event_type\nbuiltin_interfaces/Time stamp\nuint8[16] client_gid\nint64 sequence_number\n"
)
_PARTS: Final = ("request", "response", "event")


@dataclass(frozen=True, slots=True)
class RosServiceType:
    """A type of service whose messages `decode` and `encode` know.

    Attributes:
        name: such as "std_srvs/srv/SetBool".
        type_hash: "RIHS01_...".
    """

    name: str
    type_hash: str

    @property
    def request(self) -> str:
        """Name of the request's type."""
        return f"{self.name}_Request"

    @property
    def response(self) -> str:
        """Name of the response's type."""
        return f"{self.name}_Response"


def service_type(name: str, definition: str, messages: Mapping[str, str] | None = None) -> RosServiceType:
    """Make a type of service known.

    Args:
        name: such as "std_srvs/srv/SetBool".
        definition: the text of its .srv file.
        messages: the texts of .msg files that it needs and ROS 2 itself does not bring, by their type.
    """
    request, _, response = definition.partition("---")
    types = library("rosbags.typesys", "ros")
    made: dict[str, Any] = {}
    for type_name, text in (messages or {}).items():
        made |= types.get_types_from_msg(text, type_name)
    for part, text in (("Request", request), ("Response", response)):
        # the library takes definitions of messages only: a type of a service is renamed
        (fields,) = types.get_types_from_msg(text, f"{name.replace('/srv/', '/msg/')}_{part}").values()
        made[f"{name}_{part}"] = fields
    type_store().register(made)
    return RosServiceType(name, _hash(name, made, types))


def _hash(name: str, made: Mapping[str, Any], types: Any) -> str:
    kinds = library("rosbags.interfaces", "ros").Nodetype
    nested, sequence = kinds.NAME, kinds.SEQUENCE
    info = types.get_types_from_msg(_EVENT_INFO_TEXT, EVENT_INFO)
    one_at_most = {part: (sequence, ((nested, f"{name}_{part.title()}"), 1)) for part in _PARTS[:2]}
    store = types.get_typestore(types.Stores.ROS2_JAZZY)
    store.fielddefs |= info | made
    store.fielddefs[f"{name}_Event"] = ([], [("info", (nested, EVENT_INFO)), *one_at_most.items()])
    store.fielddefs[name] = ([], [(f"{part}_message", (nested, f"{name}_{part.title()}")) for part in _PARTS])
    return str(store.hash_rihs01(name))
