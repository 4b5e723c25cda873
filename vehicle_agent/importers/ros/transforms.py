"""`tf_static`: where sensors are mounted, as a tree of frames."""

from collections import deque
from collections.abc import Iterable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.se3 import R_from_quaternion_xyzw, T_from_R_t, T_inverse

F64 = NDArray[np.float64]

BASES: Final = ("base_footprint", "base_link", "vehicle", "ego_vehicle", "body", "rear_axle")
"""Frames of vehicles, x forward (REP 105); the first that is there is the vehicle's."""


def T_of_pose(position: Any, orientation: Any) -> F64:
    """(4, 4) of a position (or translation) and an orientation (or rotation); a quaternion of zeros turns nothing."""
    q = np.array([orientation.x, orientation.y, orientation.z, orientation.w])
    if not np.isfinite(q).all() or np.linalg.norm(q) < 1e-6:
        q = np.array([0.0, 0.0, 0.0, 1.0])
    return T_from_R_t(R_from_quaternion_xyzw(q), (position.x, position.y, position.z))


class StaticTransforms:
    """T_parent_child of frames that do not move against each other."""

    def __init__(self) -> None:
        self._next: dict[str, dict[str, F64]] = {}

    def add(self, transforms: Iterable[Any]) -> None:
        """Those of a TFMessage."""
        for one in transforms:
            parent, child = one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/")
            T = T_of_pose(one.transform.translation, one.transform.rotation)
            self._next.setdefault(parent, {})[child] = T
            self._next.setdefault(child, {})[parent] = T_inverse(T)

    @property
    def frames(self) -> frozenset[str]:
        """All that are known."""
        return frozenset(self._next)

    def between(self, target: str, source: str) -> F64 | None:
        """(4, 4) T_target_source; None where nothing connects them."""
        target, source = target.lstrip("/"), source.lstrip("/")
        found, queue = {target: np.eye(4)}, deque([target])
        while queue:
            at = queue.popleft()
            if at == source:
                return found[at]
            for child, T in self._next.get(at, {}).items():
                if child not in found:
                    found[child] = found[at] @ T
                    queue.append(child)
        return found.get(source)

    def base(self, also: Iterable[str] = ()) -> str | None:
        """The vehicle's frame: one that odometry calls so, or one of the usual names."""
        named = [one.lstrip("/") for one in also]
        return next((one for one in (*BASES, *named) if one in self.frames or one in named), None)
