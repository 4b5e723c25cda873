"""The particle filter's update as in the textbook: a loop over particles, 2 x 2 matrices, numeric Jacobians."""

from math import atan2, hypot, log, pi

import numpy as np


def h(pose: np.ndarray, feature: np.ndarray) -> np.ndarray:
    """Range and bearing."""
    dx, dy = feature - pose[:2]
    return np.array([hypot(dx, dy), turned(atan2(dy, dx) - pose[2])])


def turned(angle: float) -> float:
    return (angle + pi) % (2 * pi) - pi


def jacobian(pose: np.ndarray, feature: np.ndarray) -> np.ndarray:
    """Of h with respect to the feature, by central differences."""
    columns = []
    for axis in range(2):
        step = np.zeros(2)
        step[axis] = 1e-5
        off = h(pose, feature + step) - h(pose, feature - step)
        off[1] = turned(off[1])
        columns.append(off / 2e-5)
    return np.stack(columns, axis=1)


def log_normal(nu: np.ndarray, cov: np.ndarray) -> float:
    return float(-0.5 * nu @ np.linalg.solve(cov, nu) - 0.5 * log(np.linalg.det(2 * pi * cov)))


def ekf(
    pose: np.ndarray, mu: np.ndarray, sigma: np.ndarray, z: np.ndarray, R: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Eq. (16) and (18) with their misprints corrected."""
    H = jacobian(pose, mu)
    Q = H @ sigma @ H.T + R
    K = sigma @ H.T @ np.linalg.inv(Q)
    nu = z - h(pose, mu)
    nu[1] = turned(nu[1])
    return mu + K @ nu, (np.eye(2) - K @ H) @ sigma, log_normal(nu, Q)


def unpacked(row: np.ndarray) -> np.ndarray:
    return np.array([[row[0], row[1]], [row[1], row[2]]])
