"""rmw_zenoh's keys, tokens and attachments, as real nodes of ROS 2 make them, over a real router."""

import threading
import time

import pytest
import zenoh

from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.errors import BusConfigError
from gnd.fleet_bus.ros2 import (
    LATCHED_QOS,
    NO_HASH,
    SENSOR_QOS,
    RosMessage,
    RosNode,
    RosQos,
    RosTopic,
    endpoint_of_token,
    publishers_of,
)
from gnd.fleet_bus.ros2_attachments import RosAttachment

STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
CHATTER = RosTopic("/chatter", "std_msgs/msg/String", STRING_HASH)
HELLO = b"\x00\x01\x00\x00\x06\x00\x00\x00hello\x00"
# Of the talker and the listener of ROS 2's demos, as rmw_zenoh's docs/design.md shows them.
TALKER = (
    "@ros2_lv/0/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/"
    f"%chatter/std_msgs::msg::dds_::String_/{STRING_HASH}/::,7:,:,:,,"
)
LISTENER = (
    "@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MS/%/%/listener/"
    f"%chatter/std_msgs::msg::dds_::String_/{STRING_HASH}/::,10:,:,:,,"
)


def node(endpoint: str, name: str, domain: int = 0) -> RosNode:
    return RosNode(open_bus(BusConfig(connect=(endpoint,)), name=name), domain, name)


def wait_for(condition, timeout_s: float = 10.0) -> bool:
    deadline_s = time.monotonic() + timeout_s
    while not condition() and time.monotonic() < deadline_s:
        time.sleep(0.01)
    return bool(condition())


def test_the_key_is_that_of_rmw_zenoh() -> None:
    assert CHATTER.key(0) == f"0/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"
    assert RosTopic("/a/b", "sensor_msgs/msg/Imu", NO_HASH).key(7) == f"7/a/b/sensor_msgs::msg::dds_::Imu_/{NO_HASH}"


def test_tokens_of_real_nodes_are_understood() -> None:
    talker, listener = endpoint_of_token(TALKER), endpoint_of_token(LISTENER)
    assert talker is not None
    assert listener is not None
    assert (talker.kind, talker.node, talker.topic, talker.qos) == ("MP", "/talker", CHATTER, RosQos(depth=7))
    assert (listener.kind, listener.node, listener.qos) == ("MS", "/listener", RosQos(depth=10))


@pytest.mark.parametrize(
    "token",
    [
        "@ros2_lv/0/aac3178e/0/0/NN/%/%/listener",
        TALKER.replace("/MP/", "/SS/"),
        TALKER.removesuffix(",,") + ":x",
        TALKER.replace("::,7:,:,:,,", "nothing"),
        TALKER.replace("std_msgs::msg::dds_::String_", "String"),
        "gnd/v1/alive/agent/a",
        "",
    ],
)
def test_other_tokens_are_passed_over(token: str) -> None:
    found = endpoint_of_token(token)
    assert found is None or found.qos == RosQos(depth=7)


@pytest.mark.parametrize("qos", [RosQos(), SENSOR_QOS, LATCHED_QOS, RosQos(depth=0), RosQos(reliable=False, depth=1)])
def test_quality_of_service_survives_a_token(qos: RosQos) -> None:
    assert RosQos.of_text(str(qos)) == qos


GID = bytes(range(16))
PLAIN = b"\x05" + bytes(7) + b"\x07" + bytes(7) + b"\x10" + GID
NAMED = b"\x0fsequence_number\x05" + bytes(7) + b"\x10source_timestamp\x07" + bytes(7) + b"\x0asource_gid\x10" + GID


@pytest.mark.parametrize(("data", "has_names"), [(PLAIN, False), (NAMED, True)])
def test_attachments_have_the_bytes_of_both_layouts_of_rmw_zenoh(data: bytes, has_names: bool) -> None:
    assert RosAttachment(5, 7, GID, has_names).encode() == data
    assert RosAttachment.decode(data) == RosAttachment(5, 7, GID, has_names)


def test_other_bytes_are_no_attachment() -> None:
    assert RosAttachment(5, 7, GID).encode() == PLAIN  # what releases since 2025 read
    for damaged in (b"", PLAIN[:-1], NAMED[:-1], b"\xff" * 40, b"\x0fsequence_number"):
        assert RosAttachment.decode(damaged) is None


@pytest.mark.parametrize(
    ("name", "type_name"),
    [
        ("chatter", "a/msg/B"),
        ("/", "a/msg/B"),
        ("/a//b", "a/msg/B"),
        ("/a*", "a/msg/B"),
        ("/a", "a/B"),
        ("/a", "a/msg/*"),
    ],
)
def test_what_cannot_be_part_of_a_key_is_refused(name: str, type_name: str) -> None:
    with pytest.raises(BusConfigError, match="is not like"):
        RosTopic(name, type_name)


def test_messages_go_from_node_to_node_and_the_graph_shows_both(router: str) -> None:
    got: list[RosMessage] = []
    with (
        node(router, "talker", 3) as talker,
        node(router, "listener", 3) as listener,
        node(router, "other", 4) as other,
    ):
        strangers: list[RosMessage] = []
        listener.subscribe(CHATTER, got.append)
        other.subscribe(CHATTER, strangers.append)
        publisher = talker.publisher(CHATTER)
        assert wait_for(lambda: len(listener.endpoints()) == 2)
        found = listener.endpoints()
        assert publishers_of(found, "std_msgs/msg/String") == ["/chatter"]
        assert publishers_of(found, "sensor_msgs/msg/Imu") == []
        assert {(one.kind, one.node) for one in found} == {("MP", "/talker"), ("MS", "/listener")}
        deadline_s = time.monotonic() + 10
        while not got and time.monotonic() < deadline_s:  # the router learns of subscriptions a moment later
            publisher.put(HELLO, published_ns=17)
            time.sleep(0.05)
        assert got[0].payload == HELLO
        assert (got[0].topic, got[0].published_ns, len(got[0].publisher)) == ("/chatter", 17, 16)
        assert [message.sequence for message in got] == list(range(got[0].sequence, got[0].sequence + len(got)))
        assert not strangers


def test_a_latched_topic_reaches_who_comes_late(router: str) -> None:
    latched = RosTopic("/latched", "std_msgs/msg/String", STRING_HASH)
    got: list[RosMessage] = []
    with node(router, "early", 5) as early:
        early.publisher(latched, LATCHED_QOS).put(HELLO)
        with node(router, "late", 5) as late:
            late.subscribe(latched, got.append, LATCHED_QOS)
            assert wait_for(lambda: bool(got))
    assert got[0].payload == HELLO


def test_a_slow_subscriber_keeps_the_newest_and_counts_the_rest(router: str) -> None:
    got: list[int] = []
    go_on = threading.Event()

    def slow(message: RosMessage) -> None:
        go_on.wait(10)
        got.append(message.sequence)

    topic = RosTopic("/fast", "std_msgs/msg/String", STRING_HASH)
    with node(router, "talker", 6) as talker, node(router, "listener", 6) as listener:
        subscription = listener.subscribe(topic, slow, RosQos(reliable=False, depth=2))
        publisher = talker.publisher(topic)
        assert wait_for(lambda: len(listener.endpoints()) == 2)
        time.sleep(0.2)
        for _ in range(10):
            publisher.put(HELLO)
        assert wait_for(lambda: subscription.dropped >= 7)
        go_on.set()
        assert wait_for(lambda: got[-1:] == [10])
        assert got[-2:] == [9, 10]
        assert len(got) in (2, 3)  # the first, where it was taken before the others came
        assert (subscription.dropped, subscription.lost) == (10 - len(got), 0)


def test_a_gap_in_the_numbers_is_counted_as_lost(router: str) -> None:
    topic = RosTopic("/gaps", "std_msgs/msg/String", STRING_HASH)
    with node(router, "listener", 7) as listener, open_bus(BusConfig(connect=(router,))) as plain:
        got: list[RosMessage] = []
        subscription = listener.subscribe(topic, got.append)
        time.sleep(0.2)
        with plain.connection.sending() as session:
            for sequence in (1, 2, 6):
                session.put(topic.key(7), zenoh.ZBytes(HELLO), attachment=RosAttachment(sequence, 0, GID).encode())
        assert wait_for(lambda: len(got) == 3)
        assert subscription.lost == 3


def test_a_publisher_without_hash_is_heard(router: str) -> None:
    """ROS 2 Humble."""
    topic = RosTopic("/humble", "std_msgs/msg/String", NO_HASH)
    got: list[RosMessage] = []
    with node(router, "talker", 8) as talker, node(router, "listener", 8) as listener:
        listener.subscribe(RosTopic(topic.name, topic.type_name, STRING_HASH), got.append)
        publisher = talker.publisher(topic)
        assert wait_for(lambda: len(listener.endpoints()) == 2)
        time.sleep(0.2)
        publisher.put(HELLO)
        assert wait_for(lambda: bool(got))
        with pytest.raises(BusConfigError, match="needs the hash"):
            talker.publisher(RosTopic("/x", "std_msgs/msg/String"))
