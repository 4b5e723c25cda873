"""Hashes of types of services are those that ROS 2 itself publishes."""

import numpy as np
import pytest

from gnd.vehicle_agent.sources.ros2_messages import BadRosMessage, decode, encode
from gnd.vehicle_agent.sources.ros2_services import service_type

# Of example_interfaces: rmw_zenoh, docs/design.md. Of the others: idl__description.c of a build of ROS 2.
PUBLISHED = (
    (
        "example_interfaces/srv/AddTwoInts",
        "int64 a\nint64 b\n---\nint64 sum\n",
        "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a",
    ),
    (
        "std_srvs/srv/SetBool",
        "bool data # e.g. for hardware enabling / disabling\n---\nbool success\nstring message\n",
        "RIHS01_abe9e4bb6b41b40e6789712c00ec8871923e089af3f667a79992a428cff2da0a",
    ),
    (  # an empty request, and messages within messages
        "nav_msgs/srv/GetMap",
        "# Get the map\n---\nnav_msgs/OccupancyGrid map\n",
        "RIHS01_c8ae77c9995b3554b5ba80e4d4d443f970ac65143102a1d893ec24fc07b31147",
    ),
)


@pytest.mark.parametrize(("name", "definition", "published"), PUBLISHED)
def test_the_hash_is_the_one_that_ros_publishes(name: str, definition: str, published: str) -> None:
    made = service_type(name, definition)
    assert made.type_hash == published
    assert service_type(name, definition) == made  # may be made known again


def test_another_field_is_another_hash() -> None:
    name, definition, published = PUBLISHED[1]
    other = service_type(f"{name}2", definition.replace("string message", "string text"))
    assert other.type_hash not in (published, service_type(f"{name}3", definition).type_hash)


def test_its_messages_go_through_cdr() -> None:
    made = service_type(*PUBLISHED[0][:2])
    assert encode(made.request, {"a": 1, "b": -2}) == b"\0\1\0\0" + np.array([1, -2], "<i8").tobytes()
    assert decode(made.request, encode(made.request, {"a": 1, "b": -2})).b == -2
    with pytest.raises(BadRosMessage, match="AddTwoInts_Request"):
        decode(made.request, encode(made.request, {"a": 1})[:-1])
