"""What a bag holds beside its clouds: fixes, speed and yaw rate, static transforms, poses."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.schemas.drive import GnssFix, MotionSample
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.recording import GNSS_SIGMA_M
from gnd.vehicle_agent.importers.ros.bag import Bag, BagMessage, Topic
from gnd.vehicle_agent.importers.ros.transforms import StaticTransforms, T_of_pose
from gnd.vehicle_agent.importers.trajectories.guesses import coordinates_of, looks_like_camera
from gnd.vehicle_agent.importers.trajectories.pose_table import PoseTable

F64 = NDArray[np.float64]

NAV_SAT_FIX: Final = "sensor_msgs/msg/NavSatFix"
ODOMETRY: Final = "nav_msgs/msg/Odometry"
IMU: Final = "sensor_msgs/msg/Imu"
TWIST: Final = "geometry_msgs/msg/TwistStamped"
TWIST_COVARIANCE: Final = "geometry_msgs/msg/TwistWithCovarianceStamped"
POSE: Final = "geometry_msgs/msg/PoseStamped"
POSE_COVARIANCE: Final = "geometry_msgs/msg/PoseWithCovarianceStamped"
TF: Final = "tf2_msgs/msg/TFMessage"
SMALL: Final = frozenset((NAV_SAT_FIX, ODOMETRY, IMU, TWIST, TWIST_COVARIANCE, POSE, POSE_COVARIANCE, TF))
SPEEDS: Final = (ODOMETRY, TWIST, TWIST_COVARIANCE)
"""Types that give speed, the best first."""
STAMPED_NS: Final = 100_000_000 * 1_000_000_000
"""A stamp before 1973 is a clock that nobody set: the log time is taken."""
NEAR_NS: Final = 200_000_000
"""An IMU's turn rate this near to a speed belongs to it; a speed without one is left out."""


@dataclass(slots=True)
class Small:
    """By topic: times and messages, as decoded."""

    transforms: StaticTransforms = field(default_factory=StaticTransforms)
    by_topic: dict[str, list[tuple[int, Any]]] = field(default_factory=dict)
    moving: list[tuple[int, Any]] = field(default_factory=list)


def read_small(bag: Bag) -> Small:
    """All small messages of a bag; fits into memory for hours (an IMU at 200 Hz: 0.7 M messages an hour)."""
    small = Small()
    kinds = {topic.name: topic.kind for topic in bag.topics if topic.kind in SMALL}
    for message in bag.messages(list(kinds)):
        content = bag.decode(message.data, kinds[message.topic])
        if kinds[message.topic] != TF:
            small.by_topic.setdefault(message.topic, []).append((stamp_of(content.header, message), content))
        elif "static" in message.topic:
            small.transforms.add(content.transforms)
        else:
            small.moving += [(stamp_of(one.header, message), one) for one in content.transforms]
    return small


def stamp_of(header: Any, message: BagMessage) -> int:
    """When it was measured; when it was recorded, where the clock of the sensor was not set."""
    stamp = int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
    return stamp if stamp > STAMPED_NS else message.log_ns


def fixes_of_topic(messages: list[tuple[int, Any]]) -> tuple[tuple[GnssFix, ...], tuple[str, ...]]:
    """The fixes with a position, in time order, and what was left out or not known.

    NavSatFix: heights above the ellipsoid; the covariance is east, north, up; type 0: not known.
    """
    fixes: dict[int, GnssFix] = {}
    without = unknown = 0
    for t_ns, fix in messages:
        if fix.status.status < 0 or not np.isfinite([fix.latitude, fix.longitude, fix.altitude]).all():
            without += 1
            continue
        variance = 0.5 * (float(fix.position_covariance[0]) + float(fix.position_covariance[4]))
        known = fix.position_covariance_type != 0 and np.isfinite(variance) and variance > 0.0
        unknown += not known
        sigma_m = float(np.sqrt(variance)) if known else GNSS_SIGMA_M
        place = float(np.radians(fix.latitude)), float(np.radians(fix.longitude)), float(fix.altitude)
        fixes[t_ns] = GnssFix(t_ns, *place, sigma_m)
    notes = [f"{without} fixes without a position: left out"] if without else []
    notes += [f"{unknown} fixes without a covariance: taken as {GNSS_SIGMA_M} m"] if unknown else []
    return tuple(fixes[t] for t in sorted(fixes)), tuple(notes)


def motion_of_topic(
    kind: str, messages: list[tuple[int, Any]], imu: list[tuple[int, Any]], R_base_imu: F64 | None
) -> tuple[tuple[MotionSample, ...], str]:
    """Speed and yaw rate of a topic that gives speed; the yaw rate of an IMU where the topic gives none.

    Returns:
        The samples, none where the topic's twists are all zero although poses move or no turn rate is near them, and
        the sentence that says so.
    """
    twist: Callable[[Any], Any] = (lambda one: one.twist) if kind == TWIST else (lambda one: one.twist.twist)
    twists = {t: (float(twist(one).linear.x), float(twist(one).angular.z)) for t, one in messages}
    t_ns = sorted(twists)
    speed, rate = np.array([twists[t] for t in t_ns]).reshape(-1, 2).T
    if kind == ODOMETRY and not speed.any() and _moves(messages):
        return (), "its twist is zero although its poses move"
    said, near = "", np.ones(len(t_ns), bool)
    if not rate.any() and imu and R_base_imu is not None:
        imu_ns = np.array([t for t, _ in imu], np.int64)
        gyro = np.array([[one.angular_velocity.x, one.angular_velocity.y, one.angular_velocity.z] for _, one in imu])
        order = np.argsort(imu_ns, kind="stable")
        rate = np.interp(t_ns, imu_ns[order], (gyro @ R_base_imu.T)[order, 2])
        near = _is_near(np.array(t_ns, np.int64), imu_ns[order])
        said = "yaw rate of the IMU"
    good = np.isfinite(speed) & np.isfinite(rate) & near
    samples = tuple(
        MotionSample(t, float(v), float(w)) for t, v, w, ok in zip(t_ns, speed, rate, good, strict=True) if ok
    )
    return samples, "no turn rate of the IMU near its times" if said and not near.any() else said


def _is_near(t_ns: NDArray[np.int64], others_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(N,) whether one of the others, which grow, is within `NEAR_NS`."""
    after = np.searchsorted(others_ns, t_ns)
    before_ns, after_ns = others_ns[np.maximum(after - 1, 0)], others_ns[np.minimum(after, len(others_ns) - 1)]
    return np.asarray(np.minimum(np.abs(t_ns - before_ns), np.abs(after_ns - t_ns)) <= NEAR_NS)


def _moves(messages: list[tuple[int, Any]]) -> bool:
    first, last = messages[0][1].pose.pose.position, messages[-1][1].pose.pose.position
    return bool(np.hypot(last.x - first.x, last.y - first.y) > 1.0)


def poses_of_topic(bag: Bag, small: Small, topics: tuple[Topic, ...], wanted: str, base: str | None) -> PoseTable:
    """Poses on a topic: Odometry, PoseStamped, PoseWithCovarianceStamped, or tf as TOPIC:PARENT:CHILD.

    Poses of another frame than the vehicle's are brought to it by `tf_static`, where it connects them.

    Raises:
        ImportDriveError: no such topic, or one of another type.
    """
    name, *frames = wanted.split(":")
    kind = next((topic.kind for topic in topics if topic.name == name), None)
    if kind == TF and len(frames) == 2:
        rows = {t: T_of_pose(one.transform.translation, one.transform.rotation) for t, one in small.moving
                if (one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/")) == tuple(frames)}  # fmt: skip
        child = frames[1]
    elif kind in (ODOMETRY, POSE, POSE_COVARIANCE):
        messages = small.by_topic.get(name, [])
        poses = [(t, one.pose if kind == POSE else one.pose.pose, one) for t, one in messages]
        rows = {t: T_of_pose(pose.position, pose.orientation) for t, pose, _ in poses}
        child = poses[0][2].child_frame_id if kind == ODOMETRY and poses else ""
    else:
        held = ", ".join(topic.name for topic in topics if topic.kind in (ODOMETRY, POSE, POSE_COVARIANCE)) or "none"
        moving = sorted({f"{one.header.frame_id}:{one.child_frame_id}" for _, one in small.moving})
        raise ImportDriveError(
            f"--poses {wanted}: neither a file nor a topic with poses in {bag.place}; topics with poses: {held}; tf:"
            f" {', '.join(f'/tf:{pair}' for pair in moving) or 'none'}"
        )
    if not rows:
        raise ImportDriveError(f"--poses {wanted}: no such poses in {bag.place}")
    t_ns = np.array(sorted(rows), np.int64)
    T, notes = np.stack([rows[int(t)] for t in t_ns]), list[str]()
    lever = small.transforms.between(child, base) if base and child and child.lstrip("/") != base else None
    if lever is not None:
        T = T @ lever
        notes.append(f"{name}: poses of {child}, brought to {base} by tf_static")
    p, R = T[:, :3, 3].copy(), T[:, :3, :3].copy()
    camera = looks_like_camera(p, R)
    return PoseTable(f"{name} of {bag.place.name}", t_ns, p, R, coordinates_of(p), camera=camera, notes=tuple(notes))
