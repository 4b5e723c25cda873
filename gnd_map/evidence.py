"""Evidence of map changes: Dempster-Shafer masses of a voxel from counted observations (GND, 4.3 and 4.4).

Each observation gives simple masses on {S}, {C} (sustained, changed) and Ω (unknown). Dempster's rule (Eq. 11)
multiplies commonalities q(A) = Σ_{B ⊇ A} m(B), so n equal observations have a closed form and order does not matter;
with a = n_BI, b = n_BO + n_BE, c = n_PI

    ln q(S) = (a + b)·ln(1 - λcb) + c·ln(1 - λcp)
    ln q(C) = a·ln(1 - λs)
    ln q(Ω) = a·ln(1 - λs - λcb) + b·ln(1 - λcb) + c·ln(1 - λcp)

and m(S) ∝ q(S) - q(Ω), m(C) ∝ q(C) - q(Ω), m(Ω) ∝ q(Ω). Counts of scans, drives and vehicles add. PO and PE change
nothing (Eq. 8, 10).
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import F64, check_array
from gnd.gnd_map.errors import ConfigError
from gnd.gnd_map.settings import check_settings, setting


@dataclass(frozen=True, slots=True)
class MassParameters:
    """The probabilities of the evidence model, each in [0, 1)."""

    lambda_s_block: float = setting(
        0.2, 'λs,block: a point blocked inside the Gaussian says "sustained" (Eq. 5).', least=0, below=1
    )
    lambda_c_block: float = setting(0.05, 'λc,block: a blocked point says "changed" (Eq. 5, 6, 9).', least=0, below=1)
    lambda_c_pass: float = setting(
        0.02, 'λc,pass: a ray through the Gaussian says "changed" (Eq. 7).', least=0, below=1
    )

    def __post_init__(self) -> None:
        check_settings(self, ConfigError)
        if self.lambda_s_block + self.lambda_c_block > 1.0:
            raise ConfigError(
                f"lambda_s_block + lambda_c_block = {self.lambda_s_block + self.lambda_c_block} exceeds 1: "
                "the masses of one observation (Eq. 5) would not sum to 1"
            )


class ChangeState(IntEnum):
    """What the evidence says of a voxel: the largest of its masses, the column of `masses`."""

    SUSTAINED = 0
    CHANGED = 1
    UNKNOWN = 2


def masses(
    n_bi: npt.ArrayLike,
    n_bo: npt.ArrayLike,
    n_be: npt.ArrayLike,
    n_pi: npt.ArrayLike,
    parameters: MassParameters,
) -> F64:
    """(N, 3) masses m(S), m(C), m(Ω), rows summing to 1, from observation counts (N,) each; any size of counts.

    Args:
        n_bi: points blocked inside the map's Gaussian.
        n_bo: points blocked in its voxel, but outside it.
        n_be: points blocked in a voxel without Gaussian.
        n_pi: rays that passed the Gaussian.
        parameters: the evidence model.

    Raises:
        ShapeError: the counts differ in number or are not finite.
    """
    a, outside, in_empty, c = (np.asarray(n, dtype=np.float64) for n in (n_bi, n_bo, n_be, n_pi))
    for name, counts in (("n_bi", a), ("n_bo", outside), ("n_be", in_empty), ("n_pi", c)):
        check_array(name, counts, np.float64, (len(a),))
    b = outside + in_empty
    ls, lcb, lcp = parameters.lambda_s_block, parameters.lambda_c_block, parameters.lambda_c_pass
    ln_s = (a + b) * np.log1p(-lcb) + c * np.log1p(-lcp)
    ln_c = a * np.log1p(-ls)
    ln_omega = _times_log(a, 1.0 - ls - lcb) + b * np.log1p(-lcb) + c * np.log1p(-lcp)
    largest = np.maximum(ln_s, ln_c)  # Eq. 11's normalisation cancels this common factor: nothing underflows
    m_s = np.exp(ln_s - largest) * -np.expm1(ln_omega - ln_s)
    m_c = np.exp(ln_c - largest) * -np.expm1(ln_omega - ln_c)
    raw = np.stack([m_s, m_c, np.exp(ln_omega - largest)], axis=-1) + 0.0  # no negative zeros
    return np.asarray(raw / raw.sum(axis=-1, keepdims=True))


def _times_log(n: F64, x: float) -> F64:
    """n·ln(x) with 0·ln(0) = 0."""
    return n * np.log(x) if x > 0.0 else np.where(n > 0.0, -np.inf, 0.0)


def states(mass: F64) -> npt.NDArray[np.uint8]:
    """(N,) uint8 `ChangeState` with the largest mass of (N, 3) masses (GND, 4.4); a tie is unknown."""
    check_array("mass", mass, np.float64, (None, 3))
    best = np.argmax(mass, axis=1)
    tied = (mass == mass.max(axis=1, keepdims=True)).sum(axis=1) > 1
    return np.where(tied, ChangeState.UNKNOWN, best).astype(np.uint8)
