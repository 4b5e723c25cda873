"""The curves of OpenDRIVE: reference lines of lines, arcs, clothoids and cubics, and profiles along them.

Formulas: ASAM OpenDRIVE 1.8, sections 9 (Geometry) and 10.5 (Elevation). Clothoids by Fresnel integrals (Abramowitz and
Stegun, 7.3), exact to the rounding of scipy's.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from scipy.special import fresnel

from gnd.gnd_map.arrays import F64

Curve: TypeAlias = Callable[[F64], tuple[F64, F64, F64]]
"""From distances (N,) along a piece to x, y in its own frame and heading, each (N,)."""
_STRAIGHT: Final = 1e-9
"""Radians: a curvature that turns less over the whole piece is none; likewise a change of curvature."""
_FINE: Final = 4096


@dataclass(frozen=True, slots=True)
class CurvePiece:
    """One record of a reference line: from distance s_m on, start in x, y, heading, length, curve."""

    s_m: float
    x_m: float
    y_m: float
    heading_rad: float
    length_m: float
    curve: Curve


@dataclass(frozen=True, slots=True)
class ReferenceLine:
    """The pieces of a road's reference line, by distance."""

    pieces: tuple[CurvePiece, ...]

    def at(self, s_m: F64) -> tuple[F64, F64, F64]:
        """x, y and heading, each (N,), at distances (N,)."""
        which = np.clip(np.searchsorted([p.s_m for p in self.pieces], s_m, side="right") - 1, 0, None)
        x, y, heading = (np.empty(len(s_m)) for _ in range(3))
        for number in np.unique(which):
            piece, chosen = self.pieces[number], which == number
            u, v, turn = piece.curve(s_m[chosen] - piece.s_m)
            cosine, sine = np.cos(piece.heading_rad), np.sin(piece.heading_rad)
            x[chosen] = piece.x_m + cosine * u - sine * v
            y[chosen] = piece.y_m + sine * u + cosine * v
            heading[chosen] = piece.heading_rad + turn
        return x, y, heading


def line() -> Curve:
    """A straight line."""
    return lambda s: (s, np.zeros_like(s), np.zeros_like(s))


def arc(curvature: float, length_m: float) -> Curve:
    """An arc of a circle; curvature in 1/m, positive to the left."""
    if abs(curvature) * length_m < _STRAIGHT:
        return line()
    return lambda s: (np.sin(curvature * s) / curvature, (1.0 - np.cos(curvature * s)) / curvature, curvature * s)


def spiral(start: float, end: float, length_m: float) -> Curve:
    """A clothoid: the curvature goes evenly from `start` to `end`, 1/m."""
    rate = (end - start) / length_m
    if abs(rate) * length_m**2 < _STRAIGHT:
        return arc((start + end) / 2.0, length_m)
    zero = start / rate  # so far behind the start the curvature is zero
    turned = start**2 / (2.0 * rate)  # heading at the start, seen from there
    scale = np.sqrt(np.pi / abs(rate))

    def curve(s: F64) -> tuple[F64, F64, F64]:
        sine, cosine = fresnel((s + zero) / scale)
        sine_0, cosine_0 = fresnel(zero / scale)
        along, across = scale * (cosine - cosine_0), np.sign(rate) * scale * (sine - sine_0)
        c, n = np.cos(turned), np.sin(turned)
        return c * along + n * across, c * across - n * along, start * s + rate * s**2 / 2.0

    return curve


def param_poly3(u: F64, v: F64, unit_m: float) -> Curve:
    """Cubics u(p), v(p) with coefficients (4,) a … d; p is the distance over `unit_m` (1: arc length)."""

    def curve(s: F64) -> tuple[F64, F64, F64]:
        p = s / unit_m
        slope = np.arctan2(_slope(v, p), _slope(u, p))
        return _cubic(u, p), _cubic(v, p), slope

    return curve


def poly3(v: F64, length_m: float) -> Curve:
    """A cubic v(u) with coefficients (4,); u is found from the distance along the curve."""
    fine = np.linspace(0.0, length_m, _FINE)
    step = np.hypot(1.0, _slope(v, (fine[1:] + fine[:-1]) / 2.0)) * np.diff(fine)
    way = np.concatenate([[0.0], np.cumsum(step)])

    def curve(s: F64) -> tuple[F64, F64, F64]:
        u = np.interp(s, way, fine)
        return u, _cubic(v, u), np.arctan(_slope(v, u))

    return curve


def _cubic(k: F64, p: F64) -> F64:
    return np.asarray(k[0] + p * (k[1] + p * (k[2] + p * k[3])))


def _slope(k: F64, p: F64) -> F64:
    return np.asarray(k[1] + p * (2.0 * k[2] + p * 3.0 * k[3]))


@dataclass(frozen=True, slots=True, eq=False)
class HeightProfile:
    """Cubics that follow each other: start_m (K,) ascending, coefficients (K, 4) of the distance from there."""

    start_m: F64
    coefficients: F64

    def at(self, s_m: F64) -> F64:
        """(N,) values at distances (N,); zero before the first cubic, and where there is none."""
        if not len(self.start_m):
            return np.zeros(len(s_m))
        which = np.searchsorted(self.start_m, s_m, side="right") - 1
        chosen = self.coefficients[np.maximum(which, 0)].T
        return np.where(which < 0, 0.0, _cubic(chosen, s_m - self.start_m[np.maximum(which, 0)]))


def simplified(points_m: F64, tolerance_m: float) -> F64:
    """(M, 3) some of the vertices (N, 3), such that none of the others is farther than the tolerance from the line.

    Ramer 1972, Douglas and Peucker 1973.
    """
    kept = np.zeros(len(points_m), np.bool_)
    kept[[0, -1]] = True
    open_ends = [(0, len(points_m) - 1)]
    while open_ends:
        first, last = open_ends.pop()
        if last - first < 2:
            continue
        off = _off_chord_m(points_m[first : last + 1])
        worst = int(off.argmax())
        if off[worst] > tolerance_m:
            kept[first + worst] = True
            open_ends += [(first, first + worst), (first + worst, last)]
    return points_m[kept]


def _off_chord_m(p: F64) -> F64:
    """(N,) distances from the segment between the first and the last point."""
    chord = p[-1] - p[0]
    length_2 = float(chord @ chord)
    share = np.clip((p - p[0]) @ chord / length_2, 0.0, 1.0) if length_2 > 0 else np.zeros(len(p))
    return np.asarray(np.linalg.norm(p - p[0] - share[:, None] * chord, axis=1))
