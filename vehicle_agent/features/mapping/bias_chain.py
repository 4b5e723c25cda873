"""The slow error of a low-cost GNSS receiver as a chain in the graph: first-order Gauss-Markov, exactly.

With phi_k = exp(-dt_k / tau) and q_k = sigma² (1 - phi_k²) the process b_k+1 = phi_k b_k + w, w ~ N(0, q_k), is the
same Gaussian as springs between neighbours of weight phi_k / q_k together with springs to zero: of weight
(1 - phi) / q at the ends and, with equal steps, (1 - phi)² / q in between. Hence built-in factors do, and its
precision has the diagonal (1 + phi²) / q and -phi / q beside it.
"""

from typing import NamedTuple

import numpy as np

from gnd.gnd_map.arrays import F64


class Springs(NamedTuple):
    """Weights (information, 1/m²) of one axis of the chain of G states."""

    between: F64
    """(G - 1,)"""
    prior: F64
    """(G,)"""


def gauss_markov_springs(t_s: F64, sigma_m: float, correlation_s: float) -> Springs:
    """The springs of a stationary Gauss-Markov process at times (G,), increasing, G >= 1."""
    phi = np.exp(-np.diff(t_s) / correlation_s)
    # (1 - phi) / q = 1 / (sigma² (1 + phi)), seen from either side of a step; a state has its own prior but once.
    side = 1.0 / (sigma_m**2 * (1.0 + phi))
    ends = np.concatenate([[1.0 / sigma_m**2], side]), np.concatenate([side, [1.0 / sigma_m**2]])
    return Springs(phi / (sigma_m**2 * (1.0 - phi**2)), ends[0] + ends[1] - 1.0 / sigma_m**2)
