"""Where local coordinates lie on the Earth: one rigid pose, or many along a track, each for the places near it.

A map drawn over a SLAM track shares the track's drift. When GNSS bends the track straight (`vehicle_agent.localise`),
each point of the map moves as the poses around it do, seen from above: the mean of where they put it, weighted by
1 / (distance² + (10 m)²)². So lines stay smooth where the track comes by a second time with another drift.
"""

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
from scipy.spatial import cKDTree

from gnd.gnd_map.arrays import F64, I64, check_array
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.se3 import T_from_R_t, exp_so3, transform
from gnd.tile_store.feature_io.errors import BadGeometry, FeatureFileError

MAX_DISTANCE_M: Final = 50_000.0
"""Of a local point from the nearest pose: beyond, the plane of the frame has left the ground by 200 m."""

_MOST_M: Final = 1e15
"""Squares of it are finite; no map has a number beyond it."""
_POSES: Final = 64
_BLEND_M: Final = 10.0
_ROUNDS: Final = 50
_EXACT_M: Final = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Poses that put local points into an ENU frame, each near its own place."""

    frame: LocalFrame
    at_m: F64
    """(K, 3) places in local coordinates."""
    T_frame_local: F64
    """(K, 4, 4)."""
    height_known: bool = True
    """Whether the frame's heights mean something; a track laid by GNSS without heights gives none."""

    def __post_init__(self) -> None:
        check_array("places of a placement", self.at_m, np.float64, (None, 3))
        check_array("poses of a placement", self.T_frame_local, np.float64, (len(self.at_m), 4, 4))
        if not len(self.at_m):
            raise FeatureFileError("a placement needs at least one pose")

    @classmethod
    def anchored(
        cls, lat_rad: float, lon_rad: float, height_m: float | None = None, bearing_rad: float = 0.0
    ) -> "Placement":
        """The local origin at a position, the local y axis at a bearing clockwise from north, z upwards."""
        T = T_from_R_t(exp_so3([0.0, 0.0, -bearing_rad]), np.zeros(3))
        return cls(LocalFrame(lat_rad, lon_rad, height_m or 0.0), np.zeros((1, 3)), T[None], height_m is not None)

    def geodetic(self, local_m: F64) -> tuple[F64, F64, F64]:
        """Latitude, longitude (radians) and height, each (N,), of local points (N, 3).

        Raises:
            BadGeometry: a point lies farther than 50 km from every pose.
        """
        return self.frame.geodetic_from_enu(self._enu_m(local_m))

    def local(self, lat_rad: F64, lon_rad: F64, height_m: F64) -> F64:
        """(N, 3) the local points that lie at positions, to a micrometre.

        Raises:
            BadGeometry: a position is farther than 50 km from every pose, or the poses fold the map there.
        """
        enu_m = self.frame.enu_from_geodetic(lat_rad, lon_rad, height_m)
        near = self._nearest(_each(self.T_frame_local, self.at_m), enu_m, 1, "WGS-84")[1][:, 0]
        R, t = self.T_frame_local[near, :3, :3], self.T_frame_local[near, :3, 3]
        local_m = np.einsum("nji,nj->ni", R, enu_m - t)
        for _ in range(_ROUNDS):
            off_m = enu_m - self._enu_m(local_m)
            if not len(off_m) or np.abs(off_m).max() < _EXACT_M:
                return np.asarray(local_m)
            local_m = local_m + np.einsum("nji,nj->ni", R, off_m)
        raise BadGeometry(
            f"{int((np.abs(off_m).max(axis=1) >= _EXACT_M).sum())} of {len(off_m)} positions have no local "
            f"coordinates: {np.abs(off_m).max():.2g} m are left after {_ROUNDS} rounds; the georeference folds there"
        )

    def _enu_m(self, local_m: F64) -> F64:
        """(N, 3) in the frame: the means of where the poses around put each point, the near ones counting most."""
        apart_m, which = self._nearest(self.at_m, local_m, min(_POSES, len(self.at_m)), "local")
        moved = np.einsum("nkij,nj->nki", self.T_frame_local[which, :3, :3], local_m) + self.T_frame_local[which, :3, 3]
        weight = 1.0 / (apart_m**2 + _BLEND_M**2) ** 2
        return np.asarray((weight[..., None] * moved).sum(axis=1) / weight.sum(axis=1)[:, None])

    def _nearest(self, places_m: F64, points_m: F64, n: int, what: str) -> tuple[F64, I64]:
        """(N, n) distances seen from above, and numbers, of the poses nearest to points (N, 3)."""
        if not (np.abs(points_m) <= _MOST_M).all():  # NaN fails, too
            raise BadGeometry(f"{what} points with numbers that are not finite, or beyond {_MOST_M:g} m")
        apart_m, which = cKDTree(places_m[:, :2]).query(points_m[:, :2], k=[*range(1, n + 1)])
        if len(points_m) and apart_m[:, 0].max() > MAX_DISTANCE_M:
            worst = int(apart_m[:, 0].argmax())
            raise BadGeometry(
                f"{what} point {points_m[worst].round(1).tolist()} lies {apart_m[worst, 0] / 1e3:.0f} km from the "
                f"georeference, the limit is {MAX_DISTANCE_M / 1e3:.0f} km"
            )
        return np.asarray(apart_m), np.asarray(which, np.int64)

    def as_dict(self) -> dict[str, Any]:
        """What `from_dict` reads; exact to the last bit."""
        frame = [self.frame.lat_rad, self.frame.lon_rad, self.frame.height_m]
        return {
            "frame": [value.hex() for value in frame],
            "height_known": self.height_known,
            "at_m": _packed(self.at_m),
            "T_frame_local": _packed(self.T_frame_local[:, :3]),
        }

    @classmethod
    def from_dict(cls, told: Mapping[str, Any]) -> Self:
        """A placement as `as_dict` told it; FeatureFileError when it is none."""
        try:
            at_m, T = _unpacked(told["at_m"], (3,)), np.tile(np.eye(4), (len(_unpacked(told["at_m"], (3,))), 1, 1))
            T[:, :3] = _unpacked(told["T_frame_local"], (3, 4))
            return cls(LocalFrame(*map(float.fromhex, told["frame"])), at_m, T, bool(told["height_known"]))
        except (KeyError, TypeError, ValueError) as error:
            raise FeatureFileError(f"no georeference: {type(error).__name__}: {error}") from None


def _each(T: F64, p_m: F64) -> F64:
    if len(T) == 1:
        return transform(T[0], p_m)
    return np.asarray(np.einsum("nij,nj->ni", T[:, :3, :3], p_m) + T[:, :3, 3])


def _packed(values: F64) -> str:
    return base64.b64encode(np.ascontiguousarray(values, "<f8").tobytes()).decode()


def _unpacked(text: str, shape: tuple[int, ...]) -> F64:
    return np.frombuffer(base64.b64decode(text), "<f8").reshape(-1, *shape).astype(np.float64)
