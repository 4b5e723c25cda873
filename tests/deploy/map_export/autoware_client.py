"""A client of Autoware's map services as rmw_zenoh makes one: its own zenoh session, CDR written and read by hand."""

import itertools
import secrets
import struct
import time
from dataclasses import dataclass, field

import numpy as np
import zenoh
from zenoh import ext

from gnd.deploy.map_export.autoware_messages import differential_service

HASH = differential_service().type_hash
SERVICE = "autoware_map_msgs::srv::dds_::GetDifferentialPointCloudMap_"


class Reader:
    """CDR, little-endian; alignment counts from behind the encapsulation."""

    def __init__(self, data: bytes) -> None:
        assert data[:4] == b"\x00\x01\x00\x00"
        self.data, self.at = data[4:], 0

    def take(self, kind: str):
        size = struct.calcsize(kind)
        self.at += -self.at % size
        (value,) = struct.unpack_from(f"<{kind}", self.data, self.at)
        self.at += size
        return value

    def raw(self, size: int) -> bytes:
        self.at += size
        return self.data[self.at - size : self.at]

    def text(self) -> str:
        data = self.raw(self.take("I"))
        assert data[-1] == 0
        return data[:-1].decode()

    def header(self) -> tuple[float, str]:
        return self.take("i") + 1e-9 * self.take("I"), self.text()


@dataclass(frozen=True)
class Cell:
    """A cell as it came: its points, and its bounds min_x, min_y, max_x, max_y."""

    points: np.ndarray
    bounds: tuple[float, ...]


@dataclass
class Answer:
    stamp_s: float
    frame: str
    new: dict[str, Cell] = field(default_factory=dict)
    ids_to_remove: list[str] = field(default_factory=list)


def read_cloud(data: Reader) -> np.ndarray:
    _, frame = data.header()
    height, width = data.take("I"), data.take("I")
    fields = [(data.text(), data.take("I"), data.take("B"), data.take("I")) for _ in range(data.take("I"))]
    assert (frame, height, data.take("?")) == ("map", 1, False)
    assert fields == [("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1)]
    point_step, row_step, size = data.take("I"), data.take("I"), data.take("I")
    assert (point_step, row_step, size) == (12, 12 * width, 12 * width)
    points = np.frombuffer(data.raw(size), "<f4").reshape(-1, 3)
    assert data.take("?")
    return points


def read_answer(payload: bytes, *, partial: bool = False) -> Answer:
    data = Reader(payload)
    answer = Answer(*data.header())
    for _ in range(data.take("I")):
        name = data.text()
        points = read_cloud(data)
        answer.new[name] = Cell(points, tuple(data.take("f") for _ in range(4)))
    if not partial:
        answer.ids_to_remove = [data.text() for _ in range(data.take("I"))]
    assert len(data.data) - data.at < 4
    return answer


def request(x: float, y: float, radius: float, ids=None) -> bytes:
    """CDR of GetDifferentialPointCloudMap_Request; without `ids` that of GetPartialPointCloudMap_Request."""
    made = bytearray(struct.pack("<fff", x, y, radius))
    if ids is not None:
        made += struct.pack("<I", len(ids))
        for one in ids:
            text = one.encode() + b"\x00"
            made += bytes(-len(made) % 4) + struct.pack("<I", len(text)) + text
    return b"\x00\x01\x00\x00" + bytes(made)


class AutowareClient:
    """Asks as rmw_zenoh's client does: a querier of complete servers, number, time and name of the client beside."""

    def __init__(self, endpoint: str, *, domain: int = 0, type_hash: str = HASH, namespace: str = "map") -> None:
        config = zenoh.Config()
        # as DEFAULT_RMW_ZENOH_SESSION_CONFIG.json5: a peer that knows the router
        config.insert_json5("mode", '"peer"')
        config.insert_json5("connect/endpoints", f'["{endpoint}"]')
        config.insert_json5("listen/endpoints", '["tcp/localhost:0"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("scouting/gossip/enabled", "true")
        self.session = zenoh.open(config)
        self.key = f"{domain}/{namespace}/get_differential_pointcloud_map/{SERVICE}/{type_hash}"
        self._numbers = itertools.count(1)
        self.gid = secrets.token_bytes(16)
        self.held: dict[str, np.ndarray] = {}

    def __enter__(self) -> "AutowareClient":
        return self

    def __exit__(self, *_exception: object) -> None:
        self.session.close()

    def raw(self, payload: bytes | None, beside: bytes | None, key: str = "") -> list[zenoh.Reply]:
        querier = self.session.declare_querier(
            key or self.key,
            target=zenoh.QueryTarget.ALL_COMPLETE,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=20.0,
        )
        replies = list(querier.get(payload=payload, attachment=beside))
        querier.undeclare()
        return replies

    def error(self, payload: bytes | None, beside: bytes | None) -> str:
        (reply,) = self.raw(payload, beside)
        assert reply.err is not None
        return reply.err.payload.to_string()

    def ask(self, x: float, y: float, radius: float, ids=()) -> Answer:
        number = next(self._numbers)
        beside = ext.z_serialize((ext.Int64(number), ext.Int64(time.time_ns()), self.gid)).to_bytes()
        (reply,) = self.raw(request(x, y, radius, ids), beside)
        assert reply.ok is not None, reply.err and reply.err.payload.to_string()
        assert str(reply.ok.key_expr) == self.key
        got = ext.z_deserialize(tuple[ext.Int64, ext.Int64, bytes], reply.ok.attachment)
        assert (got[0], got[2]) == (number, self.gid)
        assert abs(got[1] - time.time_ns()) < 20e9
        answer = read_answer(reply.ok.payload.to_bytes())
        assert answer.frame == "map"
        return answer

    def update(self, x: float, y: float, radius: float) -> Answer:
        """As Autoware's localiser: name what is held, add what is new, drop what is to go."""
        answer = self.ask(x, y, radius, list(self.held))
        assert self.held.keys().isdisjoint(answer.new)
        assert self.held.keys() >= set(answer.ids_to_remove)
        self.held |= {name: cell.points for name, cell in answer.new.items()}
        for name in answer.ids_to_remove:
            del self.held[name]
        return answer

    def wait_served(self, timeout_s: float = 20.0) -> None:
        """As wait_for_service: until a server's token is there."""
        domain, key = self.key.split("/", 1)
        name = "%" + key.split(f"/{SERVICE}")[0].replace("/", "%")
        until_s = time.monotonic() + timeout_s
        while time.monotonic() < until_s:
            tokens = [str(r.ok.key_expr) for r in self.session.liveliness().get(f"@ros2_lv/{domain}/**") if r.ok]
            if any(f"/SS/%/%/gnd_map/{name}/{SERVICE}/{HASH}/::,:,:,:,," in token for token in tokens):
                return
            time.sleep(0.05)
        raise AssertionError(f"no server of {name} within {timeout_s} s: {tokens}")
