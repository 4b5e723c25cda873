"""The particle filter's update as in the textbook: a loop over particles, 2 x 2 matrices, numeric Jacobians."""

from math import atan2, hypot, log, pi

import numpy as np


def h(pose: np.ndarray, feature: np.ndarray) -> np.ndarray:
    """Range and bearing."""
    dx, dy = feature - pose[:2]
    return np.array([hypot(dx, dy), turned(atan2(dy, dx) - pose[2])])


def turned(angle: float) -> float:
    return (angle + pi) % (2 * pi) - pi


def measured(pose: np.ndarray, feature: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Range and bearing (2,) as a camera with errors measures a feature (4,) with errors of its own."""
    z = h(pose, feature[:2])
    return np.array([z[0] * (1.0 + camera[0] + feature[2]), turned(z[1] + camera[1] + feature[3])])


def jacobian(pose: np.ndarray, feature: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Of `measured` with respect to the feature, by central differences."""
    columns = []
    for axis in range(4):
        step = np.zeros(4)
        step[axis] = 1e-5
        off = measured(pose, feature + step, camera) - measured(pose, feature - step, camera)
        off[1] = turned(off[1])
        columns.append(off / 2e-5)
    return np.stack(columns, axis=1)


def log_normal(nu: np.ndarray, cov: np.ndarray) -> float:
    return float(-0.5 * nu @ np.linalg.solve(cov, nu) - 0.5 * log(np.linalg.det(2 * pi * cov)))


def ekf(
    pose: np.ndarray, mean: np.ndarray, cov: np.ndarray, z: np.ndarray, R: np.ndarray, camera: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Eq. (16) and (18) with their misprints corrected."""
    H = jacobian(pose, mean, camera)
    Q = H @ cov @ H.T + R
    K = cov @ H.T @ np.linalg.inv(Q)
    nu = z - measured(pose, mean, camera)
    nu[1] = turned(nu[1])
    return mean + K @ nu, (np.eye(4) - K @ H) @ cov, log_normal(nu, Q)


def full(row: np.ndarray) -> np.ndarray:
    """A covariance (4, 4) of its ten numbers: xx, xy, yy, xe, ye, xb, yb, ee, eb, bb."""
    xx, xy, yy, xe, ye, xb, yb, ee, eb, bb = row
    return np.array([[xx, xy, xe, xb], [xy, yy, ye, yb], [xe, ye, ee, eb], [xb, yb, eb, bb]])


def unpacked(row: np.ndarray) -> np.ndarray:
    return np.array([[row[0], row[1]], [row[1], row[2]]])
