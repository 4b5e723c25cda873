"""Points of a tree on a street: trunk, twigs that stay, leaves that come and go, and a front behind it."""

import numpy as np
from things_testing import GROUND_M, box

X, Y = 15.0, 14.0
CROWN_M = 4.4


def trunk(x=X, y=Y):
    return box(x, y, 0.26, 0.26, GROUND_M, GROUND_M + CROWN_M)


def tufts(number, seed, x=X, y=Y, reach=(1.9, 1.6)):
    """Small tufts all over a crown, looked at from everywhere."""
    rng = np.random.default_rng(seed)
    way = rng.normal(size=(number, 3))
    way *= rng.uniform(0.3, 1.0, (number, 1)) / np.linalg.norm(way, axis=1, keepdims=True)
    middle = np.array([x, y, GROUND_M + CROWN_M]) + way * np.array([reach[0], reach[0], reach[1]])
    shell = rng.normal(size=(number, 60, 3))
    shell *= rng.uniform(0.16, 0.34, (number, 1, 1)) / np.linalg.norm(shell, axis=2, keepdims=True)
    return (middle[:, None] + shell).reshape(-1, 3)


TWIGS = tufts(30, 1, reach=(1.6, 1.4))
LEAVES = [tufts(110, seed) for seed in (2, 3)]
FRONT = box(X, Y + 4.4, 10.0, 1.0, GROUND_M, GROUND_M + 7.0)
