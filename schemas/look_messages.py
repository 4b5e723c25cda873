"""What detectors see in one look, as protobuf messages of a recorded drive; encode beside decode."""

from collections.abc import Iterable

import numpy as np

from gnd.gnd_map.arrays import F32
from gnd.schemas import limits
from gnd.schemas.drive import LOOK_SENSORS, Detections, LaneLook
from gnd.schemas.drive_messages import ns_of, timestamp_of
from gnd.schemas.errors import BadValue
from gnd.schemas.generated import detections_pb2, lane_look_pb2
from gnd.schemas.wire import check_length


def detections_message_of(look: Detections) -> detections_pb2.Detections:
    """gnd.v1.Detections."""
    return detections_pb2.Detections(
        timestamp=timestamp_of(look.t_ns),
        sensor=look.sensor,
        layer=look.layer,
        kinds=look.kinds,
        range_m=look.range_m.tolist(),
        bearing_rad=look.bearing_rad.tolist(),
        height_m=look.height_m.tolist(),
        sigma_range_m=look.sigma_range_m.tolist(),
        sigma_bearing_rad=look.sigma_bearing_rad.tolist(),
        free_m=look.free_m.tolist(),
        free_field_rad=look.free_field_rad,
    )


def detections_of(message: detections_pb2.Detections) -> Detections:
    """The look of a gnd.v1.Detections; `BadValue` when its columns differ in length or hold what cannot be."""
    t_ns = ns_of(message.timestamp)
    sensor = next((known for known in LOOK_SENSORS if known == message.sensor), None)
    if sensor is None:
        raise BadValue(f"look at {t_ns} ns: sensor {message.sensor!r:.80}, expected one of {', '.join(LOOK_SENSORS)}")
    return Detections(
        t_ns=t_ns,
        sensor=sensor,
        layer=message.layer,
        kinds=tuple(message.kinds),
        range_m=_floats(message.range_m),
        bearing_rad=_floats(message.bearing_rad),
        height_m=_floats(message.height_m),
        sigma_range_m=_floats(message.sigma_range_m),
        sigma_bearing_rad=_floats(message.sigma_bearing_rad),
        free_m=_floats(message.free_m),
        free_field_rad=message.free_field_rad,
    )


def lane_message_of(look: LaneLook) -> lane_look_pb2.LaneLook:
    """gnd.v1.LaneLook."""
    points = np.concatenate([np.empty((0, 2), np.float32), *look.polylines])
    return lane_look_pb2.LaneLook(
        timestamp=timestamp_of(look.t_ns),
        lengths=[len(line) for line in look.polylines],
        x_m=points[:, 0].tolist(),
        y_m=points[:, 1].tolist(),
        sigma_m=look.sigma_m,
        sigma_rad=look.sigma_rad,
    )


def lanes_of(message: lane_look_pb2.LaneLook) -> LaneLook:
    """The look of a gnd.v1.LaneLook; `BadValue` when its lengths and points do not agree or hold what cannot be."""
    t_ns = ns_of(message.timestamp)
    lengths, count = list(message.lengths), len(message.x_m)
    check_length(f"lane look at {t_ns} ns", len(lengths), limits.MAX_POLYLINES_OF_LOOK, "polylines")
    if not count == len(message.y_m) == sum(lengths):
        raise BadValue(f"lane look at {t_ns} ns: {count} x, {len(message.y_m)} y for {sum(lengths)} points")
    points = np.stack([_floats(message.x_m), _floats(message.y_m)], axis=1)
    lines = np.split(points, np.cumsum(lengths)[:-1]) if lengths else []
    return LaneLook(t_ns, tuple(np.ascontiguousarray(line) for line in lines), message.sigma_m, message.sigma_rad)


def _floats(values: Iterable[float]) -> F32:
    return np.fromiter(values, np.float32)
