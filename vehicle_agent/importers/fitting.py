"""Laying one track of positions over another."""

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.se3 import exp_so3

F64 = NDArray[np.float64]


def fit_heading_and_position(p_src_m: F64, p_dst_m: F64) -> F64:
    """(4, 4) T_dst_src, turned about the vertical only, that brings points (N, 3) closest to points (N, 3)."""
    middle_src, middle_dst = p_src_m.mean(axis=0), p_dst_m.mean(axis=0)
    a, b = (p_src_m - middle_src)[:, :2], (p_dst_m - middle_dst)[:, :2]
    yaw = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    T = np.eye(4)
    T[:3, :3] = exp_so3([0.0, 0.0, yaw])
    T[:3, 3] = middle_dst - T[:3, :3] @ middle_src
    return T
