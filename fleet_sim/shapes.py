"""The three primitives that a simulated street is made of.

All live in the *street frame*: x along the street, y to the left, z upwards from the sloping reference plane of the
street (see `gnd.fleet_sim.world`). Solid and opaque: a ray stops at the first surface that it enters.
"""

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from math import cos, isfinite, sin
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.errors import SimShapeError

BLOCK: Final = 0
POST: Final = 1
BALL: Final = 2
BOX: Final = 3
"""A block with its faces along the axes, which is by far the most frequent and the quickest to meet."""

COLUMNS: Final = 13
"""Columns of a packed primitive; their meaning depends on the kind in column 0 (see `pack`)."""
REFLECTIVITY: Final = COLUMNS - 1
"""The column of that."""


def _check(shape: object, values: Sequence[float], positive: dict[str, float], reflectivity: float) -> None:
    if not all(isfinite(v) for v in values):
        raise SimShapeError(f"{shape}: every number must be finite")
    for name, value in positive.items():
        if value <= 0:
            raise SimShapeError(f"{shape}: {name} must be positive, got {value}")
    if not 0 < reflectivity <= 1:
        raise SimShapeError(f"{shape}: reflectivity must be in (0, 1], got {reflectivity}")


@dataclass(frozen=True, slots=True)
class Block:
    """A box turned about the vertical, whose top may slope (ground, ramps and heaps are blocks too).

    Attributes:
        x_m: centre along the street.
        y_m: centre across the street.
        half_x_m: half length along the block's own first axis.
        half_y_m: half length along its second axis.
        bottom_m: height of the flat underside.
        top_m: height of the top face above the centre.
        yaw_rad: turn of the block's first axis from the street's x, counter-clockwise.
        rise_x: slope of the top along the first axis (metres a metre).
        rise_y: slope of the top along the second axis.
        reflectivity: diffuse reflectivity at 905 nm, in (0, 1].
    """

    x_m: float
    y_m: float
    half_x_m: float
    half_y_m: float
    bottom_m: float
    top_m: float
    yaw_rad: float = 0.0
    rise_x: float = 0.0
    rise_y: float = 0.0
    reflectivity: float = 0.3

    def __post_init__(self) -> None:
        extent = {"half_x_m": self.half_x_m, "half_y_m": self.half_y_m, "top_m - bottom_m": self.top_m - self.bottom_m}
        _check(self, astuple(self), extent, self.reflectivity)

    def packed(self) -> tuple[float, ...]:
        """Return kind, x, y, half_x, half_y, bottom, top, cos, sin, rise_x, rise_y."""
        kind = BLOCK if self.yaw_rad or self.rise_x or self.rise_y else BOX
        size = (self.half_x_m, self.half_y_m, self.bottom_m, self.top_m)
        return (kind, self.x_m, self.y_m, *size, cos(self.yaw_rad), sin(self.yaw_rad), self.rise_x, self.rise_y)

    def bounds(self) -> tuple[float, float, float, float, float]:
        """Return x_min, y_min, x_max, y_max, z_max of the box around it [m]."""
        c, s = abs(cos(self.yaw_rad)), abs(sin(self.yaw_rad))
        dx, dy = c * self.half_x_m + s * self.half_y_m, s * self.half_x_m + c * self.half_y_m
        top = self.top_m + abs(self.rise_x) * self.half_x_m + abs(self.rise_y) * self.half_y_m
        return self.x_m - dx, self.y_m - dy, self.x_m + dx, self.y_m + dy, top


@dataclass(frozen=True, slots=True)
class Post:
    """A vertical cylinder.

    Attributes:
        x_m: axis along the street.
        y_m: axis across the street.
        radius_m: radius.
        bottom_m: height of the underside.
        top_m: height of the top.
        reflectivity: diffuse reflectivity at 905 nm, in (0, 1].
    """

    x_m: float
    y_m: float
    radius_m: float
    bottom_m: float
    top_m: float
    reflectivity: float = 0.3

    def __post_init__(self) -> None:
        extent = {"radius_m": self.radius_m, "top_m - bottom_m": self.top_m - self.bottom_m}
        _check(self, astuple(self), extent, self.reflectivity)

    def packed(self) -> tuple[float, ...]:
        """Return kind, x, y, radius, radius, bottom, top, zeros."""
        size = (self.radius_m, self.radius_m, self.bottom_m, self.top_m)
        return (POST, self.x_m, self.y_m, *size, 0.0, 0.0, 0.0, 0.0)

    def bounds(self) -> tuple[float, float, float, float, float]:
        """Return x_min, y_min, x_max, y_max, z_max of the box around it [m]."""
        r = self.radius_m
        return self.x_m - r, self.y_m - r, self.x_m + r, self.y_m + r, self.top_m


@dataclass(frozen=True, slots=True)
class Ball:
    """A sphere: tufts of leaves and heads of bollards.

    Attributes:
        x_m: centre along the street.
        y_m: centre across the street.
        z_m: height of the centre.
        radius_m: radius.
        reflectivity: diffuse reflectivity at 905 nm, in (0, 1].
    """

    x_m: float
    y_m: float
    z_m: float
    radius_m: float
    reflectivity: float = 0.4

    def __post_init__(self) -> None:
        _check(self, astuple(self), {"radius_m": self.radius_m}, self.reflectivity)

    def packed(self) -> tuple[float, ...]:
        """Return kind, x, y, z, radius, zeros."""
        return (BALL, self.x_m, self.y_m, self.z_m, self.radius_m, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def bounds(self) -> tuple[float, float, float, float, float]:
        """Return x_min, y_min, x_max, y_max, z_max of the box around it [m]."""
        r = self.radius_m
        return self.x_m - r, self.y_m - r, self.x_m + r, self.y_m + r, self.z_m + r


Shape = Block | Post | Ball


def pack(shapes: Sequence[Shape]) -> NDArray[np.float64]:
    """Return the primitives as one float64 array (M, 13): kind, ten numbers of its own, highest point, reflectivity."""
    rows = [(*shape.packed(), shape.bounds()[4], shape.reflectivity) for shape in shapes]
    return np.array(rows, dtype=np.float64).reshape(len(rows), COLUMNS)
