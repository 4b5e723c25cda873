"""Whitening records: what the ray kernel reads of a Gaussian, 64 bytes in one cache line.

A record is 16 words of 4 bytes. Words 0-5 the lower triangle of W = L^-1 (Σ = L L^T, so |W d|² is the squared
Mahalanobis distance of Eq. 2), 6-8 the mean relative to the window's anchor, 9-11 the unit normal (zeros where not
planar), 12-15 the int32 counters BI, BO, PI, PO.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.gaussian import full_matrices
from gnd.vehicle_agent.detect.parameters import DetectParameters

_PASS_NOISE_M: Final = 0.01
"""Keeps the whitening of flat Gaussians finite."""
_PLANAR_RATIO: Final = 10.0
"""λ2 / λ1 from which a Gaussian is planar (the paper's ratio, Eq. 16)."""

WORDS = 16
MEAN = slice(6, 9)
NORMAL = slice(9, 12)
N_BI, N_BO, N_PI, N_PO = 12, 13, 14, 15


@dataclass(frozen=True, slots=True)
class Records:
    """`words` (M, 16) int32: the records for passing rays with their counters; `floats` the same memory as float32.

    `block` (M, 6) float32: whitening of Σ + noise² I, for points that end in the voxel.
    """

    words: NDArray[np.int32]
    block: NDArray[np.float32]

    @classmethod
    def of(cls, n: int) -> "Records":
        """Room for n."""
        return cls(np.zeros((n, WORDS), np.int32), np.empty((n, 6), np.float32))

    def put(self, rows: slice | NDArray[np.bool_], others: "Records") -> None:
        """Copy others into rows of these."""
        self.words[rows], self.block[rows] = others.words, others.block

    def taken(self, rows: slice, mean_m: NDArray[np.float64]) -> "Records":
        """A copy of some rows with means (K, 3) about another anchor, counters at zero."""
        taken = Records(self.words[rows].copy(), self.block[rows])
        taken.floats[:, MEAN] = mean_m
        taken.words[:, N_BI:] = 0
        return taken

    @property
    def floats(self) -> NDArray[np.float32]:
        """The same memory read as float32."""
        return self.words.view(np.float32)


def make_records(
    mean_map_m: NDArray[np.float64],
    cov_m2: NDArray[np.float64],
    anchor_map_m: NDArray[np.float64],
    parameters: DetectParameters,
) -> Records:
    """Records of M Gaussians (means (M, 3), covariances (M, 6), map frame) about an anchor (3,), counters at zero."""
    cov = full_matrices(cov_m2)
    words = np.zeros((len(cov), WORDS), np.int32)
    floats = words.view(np.float32)
    floats[:, :6] = whitening(cov + np.eye(3) * _PASS_NOISE_M**2)
    floats[:, MEAN] = mean_map_m - anchor_map_m
    floats[:, NORMAL] = planar_normals(cov)
    return Records(words, whitening(cov + np.eye(3) * parameters.rules.block_noise_m**2).astype(np.float32))


def whitening(cov: NDArray[np.float64]) -> NDArray[np.float64]:
    """(M, 3, 3) covariances to (M, 6) lower triangles 00, 10, 11, 20, 21, 22 of W = L^-1."""
    if not len(cov):
        return np.empty((0, 6))
    W = np.linalg.inv(np.linalg.cholesky(cov))
    return np.asarray(W[:, [0, 1, 1, 2, 2, 2], [0, 0, 1, 0, 1, 2]])


def planar_normals(cov: NDArray[np.float64]) -> NDArray[np.float64]:
    """(M, 3) unit normals of the Gaussians that are planar (λ2 >= ratio λ1, Eq. 16), zeros for the others."""
    if not len(cov):
        return np.empty((0, 3))
    values, vectors = np.linalg.eigh(cov + np.eye(3) * _PASS_NOISE_M**2)
    planar = values[:, 1] >= _PLANAR_RATIO * values[:, 0]
    return np.where(planar[:, None], vectors[:, :, 0], 0.0)
