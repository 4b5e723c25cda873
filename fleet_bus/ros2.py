"""Topics of ROS 2 without ROS: the keys, tokens and attachments by which rmw_zenoh maps its graph onto zenoh.

A message is CDR on the key `DOMAIN/TOPIC/TYPE/HASH`, with an attachment of sequence number, time and publisher; nodes,
publishers and subscriptions are liveliness tokens below `@ros2_lv/DOMAIN/` (rmw_zenoh, docs/design.md, of jazzy and
later; a publisher of humble has no hash, which any hash matches here). What is in a message is not looked at.
"""

import itertools
import secrets
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Final, Literal

import zenoh
from zenoh import ext

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.config import QUEUE_LIMIT
from gnd.fleet_bus.connection import Connection
from gnd.fleet_bus.errors import BusConfigError, NoRouter
from gnd.fleet_bus.part import Part
from gnd.fleet_bus.ros2_attachments import GID_BYTES, RosAttachment
from gnd.fleet_bus.ros2_service import RosHandler, RosService
from gnd.fleet_bus.workers import Workers

TOKENS: Final = "@ros2_lv"
NO_HASH: Final = "TypeHashNotSupported"
"""Of publishers of ROS 2 Humble, whose types have no hash."""
ANY_HASH: Final = "*"
MAX_DOMAIN: Final = 232
_MANGLED_SLASH: Final = "%"
_DEFAULT_DEPTH: Final = 10
_SHUT_OUT: Final = frozenset("*$#?")
"""Characters with a meaning in key expressions: no name of ROS has them."""
EndpointKind = Literal["MP", "MS", "SS", "SC"]
"""Publisher or subscription of messages, server or client of a service."""
_KINDS: Final[dict[str, EndpointKind]] = {"MP": "MP", "MS": "MS", "SS": "SS", "SC": "SC"}


@dataclass(frozen=True, slots=True)
class RosQos:
    """Quality of service of a topic, as far as zenoh and the other side need to know it.

    Attributes:
        reliable: lost messages are sent again.
        latched: a subscriber that comes late gets the last `depth` messages ("transient local").
        depth: how many messages are kept ("keep last"); 0: all ("keep all").
    """

    reliable: bool = True
    latched: bool = False
    depth: int = _DEFAULT_DEPTH

    def __str__(self) -> str:
        """As in a token: what is the default is left out; deadline, lifespan and liveliness are the defaults."""
        history = "2," if self.depth == 0 else "," if self.depth == _DEFAULT_DEPTH else f",{self.depth}"
        return f"{'' if self.reliable else '2'}:{'1' if self.latched else ''}:{history}:,:,:,,"

    @classmethod
    def of_text(cls, text: str) -> "RosQos":
        """Read what stands in a token; BusConfigError where that is none."""
        try:
            reliability, durability, history, *_ = text.split(":")
            kind, depth = history.split(",")
            kept = 0 if kind == "2" else int(depth or _DEFAULT_DEPTH)
        except ValueError as error:
            raise BusConfigError(f"{text!r} is no quality of service of a ROS 2 token: {error}") from error
        return cls(reliable=reliability != "2", latched=durability == "1", depth=kept)


SENSOR_QOS: Final = RosQos(reliable=False, depth=5)
LATCHED_QOS: Final = RosQos(latched=True, depth=1)


@dataclass(frozen=True, slots=True)
class RosTopic:
    """A topic: where messages of which type go; or a service: its name and its type.

    Attributes:
        name: absolute, such as "/points".
        type_name: such as "sensor_msgs/msg/PointCloud2", or of a service "std_srvs/srv/SetBool".
        type_hash: "RIHS01_...", `NO_HASH`; `ANY_HASH`: whatever the publisher has.
    """

    name: str
    type_name: str
    type_hash: str = ANY_HASH

    def __post_init__(self) -> None:
        """A name and a type that can be parts of a key."""
        if not self.name.startswith("/") or "//" in self.name or len(self.name) < 2 or _SHUT_OUT & set(self.name):
            raise BusConfigError(f"topic {self.name!r} is not like /sensing/points")
        if self.type_name.count("/") != 2 or _SHUT_OUT & set(self.type_name):
            raise BusConfigError(f"type {self.type_name!r} of topic {self.name} is not like sensor_msgs/msg/Imu")

    @property
    def dds_type(self) -> str:
        """The type as it stands in keys: "sensor_msgs::msg::dds_::PointCloud2_"."""
        package, kind, name = self.type_name.split("/")
        return f"{package}::{kind}::dds_::{name}_"

    def key(self, domain: int) -> str:
        """Key of its messages."""
        return f"{domain}/{self.name.strip('/')}/{self.dds_type}/{self.type_hash}"


@dataclass(frozen=True, slots=True)
class RosMessage:
    """One message as it came.

    Attributes:
        topic: its name.
        payload: CDR with its four bytes of encapsulation.
        sequence: number of the message at its publisher, from 1; 0 where the attachment does not say.
        published_ns: when it was published, by the publisher's clock, ns; 0 where the attachment does not say.
        publisher: 16 bytes that name the publisher; b"" where the attachment does not say.
    """

    topic: str
    payload: bytes
    sequence: int
    published_ns: int
    publisher: bytes


@dataclass(frozen=True, slots=True)
class RosEndpoint:
    """A publisher, a subscription, a server or a client that is alive in a domain."""

    kind: EndpointKind
    node: str
    topic: RosTopic
    qos: RosQos


def endpoint_of_token(token: str) -> RosEndpoint | None:
    """What a liveliness token tells; None for nodes, and what is no token of ours to read."""
    parts = token.split("/")
    if len(parts) != 13 or parts[0] != TOKENS or parts[5] not in _KINDS:
        return None
    package, _, rest = parts[10].partition("::")
    kind, _, name = rest.partition("::dds_::")
    try:
        topic = RosTopic(parts[9].replace(_MANGLED_SLASH, "/"), f"{package}/{kind}/{name.removesuffix('_')}", parts[11])
        qos = RosQos.of_text(parts[12])
    except BusConfigError:
        return None
    space = parts[7].replace(_MANGLED_SLASH, "/").rstrip("/")
    return RosEndpoint(_KINDS[parts[5]], f"{space}/{parts[8]}", topic, qos)


class RosNode:
    """One node in the graph of ROS 2, on a session of its own; use it in a `with` block.

    Args:
        bus: session to a router of rmw_zenoh (or any zenoh router), which must be open; it is closed with the node.
        domain: ROS_DOMAIN_ID.
        name: of the node, in the root namespace.

    Raises:
        NoRouter: the session has not found a router yet.
        BusConfigError: a domain or a name that cannot be.
    """

    def __init__(self, bus: Bus, domain: int = 0, name: str = "gnd") -> None:
        if not 0 <= domain <= MAX_DOMAIN:
            raise BusConfigError(f"domain {domain}: 0 to {MAX_DOMAIN} are possible")
        if not name.replace("_", "a").isalnum():
            raise BusConfigError(f"node name {name!r}: letters, digits and _ are possible")
        self.bus, self.domain, self.name = bus, domain, name
        self._ids = itertools.count()
        self._node = next(self._ids)
        self._session = str(bus.connection.session.zid())
        bus.declare_alive(self._token(self._node, "NN"))

    def __enter__(self) -> "RosNode":
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the graph. May be called again."""
        self.bus.close()

    def publisher(self, topic: RosTopic, qos: RosQos = RosQos()) -> "RosPublisher":
        """Announce a topic; its type must have its hash."""
        if topic.type_hash == ANY_HASH:
            raise BusConfigError(f"{topic.name}: a publisher needs the hash of {topic.type_name}")
        self.bus.declare_alive(self._endpoint_token("MP", topic, qos))
        return self.bus.keep(RosPublisher(self.bus.connection, topic, topic.key(self.domain), qos))

    def subscribe(
        self,
        topic: RosTopic,
        callback: Callable[[RosMessage], None],
        qos: RosQos = SENSOR_QOS,
    ) -> "RosSubscription":
        """Call back with every message, in order, in one thread of our own.

        Args:
            topic: any publisher's hash is taken.
            callback: what it raises is logged, and the next message delivered.
            qos: `latched` also gets what publishers have kept; `depth` messages wait for a slow callback, then the
                oldest is dropped and counted.
        """
        key = replace(topic, type_hash=ANY_HASH).key(self.domain)
        self.bus.declare_alive(self._endpoint_token("MS", topic, qos))
        return self.bus.keep(RosSubscription(self.bus.connection, topic, key, callback, qos))

    def serve(self, service: RosTopic, handler: RosHandler) -> RosService:
        """Answer the requests of a service, also those of clients of ROS 2 Humble, whose types have no hash.

        Args:
            service: its name and type, with the hash of the type.
            handler: the answer to a request, both CDR; called in threads of our own, several at a time. `Refused`
                and whatever else it raises becomes an error at the client, which rmw_zenoh's clients only log.
        """
        if service.type_hash == ANY_HASH:
            raise BusConfigError(f"{service.name}: a service needs the hash of {service.type_name}")
        keys = (service.key(self.domain), replace(service, type_hash=NO_HASH).key(self.domain))
        serving = self.bus.keep(RosService(self.bus.connection, service.name, keys, handler))
        self.bus.declare_alive(self._endpoint_token("SS", service, RosQos()))  # who sees it may ask at once
        return serving

    def endpoints(self, timeout_s: float = 2.0) -> list[RosEndpoint]:
        """The publishers, subscriptions, servers and clients alive in the domain, this node's own among them."""
        with self.bus.connection.sending() as session:
            replies = session.liveliness().get(f"{TOKENS}/{self.domain}/**", timeout=timeout_s)
            tokens = {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}
        return [endpoint for token in sorted(tokens) if (endpoint := endpoint_of_token(token)) is not None]

    def _token(self, number: int, kind: str) -> str:
        head = f"{TOKENS}/{self.domain}/{self._session}/{self._node}/{number}/{kind}"
        return f"{head}/{_MANGLED_SLASH}/{_MANGLED_SLASH}/{self.name}"  # root enclave, root namespace

    def _endpoint_token(self, kind: EndpointKind, topic: RosTopic, qos: RosQos) -> str:
        mangled = topic.name.replace("/", _MANGLED_SLASH)
        type_hash = NO_HASH if topic.type_hash == ANY_HASH else topic.type_hash
        return f"{self._token(next(self._ids), kind)}/{mangled}/{topic.dds_type}/{type_hash}/{qos}"


class RosPublisher(Part):
    """Publishes on one topic; made by `RosNode.publisher`.

    Attributes:
        topic: where.
    """

    def __init__(self, connection: Connection, topic: RosTopic, key: str, qos: RosQos) -> None:
        super().__init__()
        self.topic, self._connection, self._key = topic, connection, key
        self._numbers, self._gid = itertools.count(1), secrets.token_bytes(GID_BYTES)
        full = zenoh.CongestionControl.BLOCK if qos.reliable and qos.depth == 0 else zenoh.CongestionControl.DROP
        if qos.latched:
            self.declare(
                connection,
                lambda session: ext.declare_advanced_publisher(
                    session,
                    key,
                    congestion_control=full,
                    cache=ext.CacheConfig(max_samples=max(qos.depth, 1)),
                    sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
                    publisher_detection=True,
                ),
            )
        else:
            reliability = zenoh.Reliability.RELIABLE if qos.reliable else zenoh.Reliability.BEST_EFFORT
            self.declare(
                connection,
                lambda session: session.declare_publisher(key, congestion_control=full, reliability=reliability),
            )

    def put(self, payload: bytes, published_ns: int | None = None) -> None:
        """Publish one message.

        Args:
            payload: CDR with its encapsulation.
            published_ns: its time; by default now.

        Raises:
            NoRouter: there has not been one yet.
            MessageTooLarge, BusClosed.
        """
        if self.declared is None:
            raise NoRouter(f"no router until now: {len(payload)} bytes on {self.topic.name} were not published")
        self._connection.outgoing(payload, "control", None)
        published_ns = time.time_ns() if published_ns is None else published_ns
        with self._connection.sending():
            beside = RosAttachment(next(self._numbers), published_ns, self._gid)
            self.declared.put(payload, attachment=beside.encode())

    def _end(self) -> None:
        self.undeclare()


class RosSubscription(Part):
    """A subscription of one topic; made by `RosNode.subscribe`.

    Attributes:
        topic: of which.
        dropped: messages thrown away because the callback was too slow.
        lost: messages that the numbers of their publishers tell were never received.
    """

    def __init__(
        self, connection: Connection, topic: RosTopic, key: str, callback: Callable[[RosMessage], None], qos: RosQos
    ) -> None:
        super().__init__()
        self.topic, self.dropped, self.lost = topic, 0, 0
        self._newest: dict[bytes, int] = {}
        limit = qos.depth or QUEUE_LIMIT
        self._workers: Workers[RosMessage] = Workers(f"ros2 {topic.name}", callback, 1, limit)
        if qos.latched:
            self.declare(
                connection,
                lambda session: ext.declare_advanced_subscriber(
                    session, key, self._accept, history=ext.HistoryConfig(detect_late_publishers=True)
                ),
            )
        else:
            self.declare(connection, lambda session: session.declare_subscriber(key, self._accept))

    def _accept(self, sample: zenoh.Sample) -> None:
        beside = b"" if sample.attachment is None else sample.attachment.to_bytes()
        told = RosAttachment.decode(beside) or RosAttachment(0, 0, b"")
        payload = sample.payload.to_bytes()
        message = RosMessage(self.topic.name, payload, told.sequence, told.sent_ns, told.gid)
        self._note(message.publisher, message.sequence)
        if not self._workers.offer_newest(message):
            self.dropped += 1

    def _note(self, publisher: bytes, sequence: int) -> None:
        """Count the gap before a number."""
        newest = self._newest.get(publisher, sequence)
        self.lost += max(0, sequence - newest - 1)
        self._newest[publisher] = max(sequence, newest)

    def _end(self) -> None:
        self.undeclare()
        self._workers.close()


def publishers_of(endpoints: Iterable[RosEndpoint], type_name: str) -> list[str]:
    """Names of the topics on which somebody publishes a type, in order."""
    return sorted({one.topic.name for one in endpoints if one.kind == "MP" and one.topic.type_name == type_name})
