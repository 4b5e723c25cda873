"""How a cheap receiver's error wanders: a Gauss-Markov process fitted to single-point fixes against a reference.

The fixes are those of the car in `gnss_nagoya` (RTKLIB, code only, all satellites, 1 Hz, a city). Errors east and north
about their medians; fixes farther off than 8 m along an axis are reflections from buildings, which a motorway has not,
and are left out. The autocorrelation at lags of 1 … 60 s is fitted by a * exp(-lag / T): T is the correlation time,
1 - a the share of the variance that is white.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from scipy.optimize import curve_fit

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from studies.frame.measure import Figure
from studies.frame.options import option
from studies.real_localisation.nagoya import read_pos, read_reference

RECORDING: Final = Path(__file__).resolve().parents[2] / "shared" / "data" / "gnss_nagoya"
REFLECTED_M: Final = 8.0
LAGS_S: Final = 60


@dataclass(frozen=True, slots=True)
class GnssNoiseOptions:
    """Which recording."""

    recording: Path = option(RECORDING, "Folder with rover_1Hz_spp.pos, reference.csv.")


OPTIONS: Final = GnssNoiseOptions


@dataclass(frozen=True, slots=True)
class FittedGnssNoise:
    """A Gauss-Markov process with white noise.

    Attributes:
        sigma_m: standard deviation of an axis, all of it.
        correlation_s: time constant T of the slow part.
        slow_share: share a of the variance that is slow.
        cep_m: median horizontal error of all fixes about the median.
        constant_m: length of the median horizontal error.
        left_out: share of the fixes that are reflections.
    """

    sigma_m: float
    correlation_s: float
    slow_share: float
    cep_m: float
    constant_m: float
    left_out: float


def run(chosen: GnssNoiseOptions | None = None) -> list[Figure]:
    """Fit the recording, if it is there."""
    chosen = chosen or GnssNoiseOptions()
    if not chosen.recording.is_dir():
        return [Figure("not measured", float("nan"), "", "no folder --recording")]
    noise = fitted(*horizontal_errors(chosen.recording))
    return [
        Figure("correlation time", noise.correlation_s, "s", f"of {noise.slow_share:.0%} of the variance"),
        Figure("white", 1.0 - noise.slow_share, "of the variance"),
        Figure("sigma of an axis", noise.sigma_m, "m", f"{noise.left_out:.0%} of the fixes left out"),
        Figure("median horizontal error", noise.cep_m, "m", "about the median error, all fixes"),
        Figure("median error", noise.constant_m, "m", "east and north together"),
    ]


def horizontal_errors(folder: Path) -> tuple[F64, F64]:
    """Times float64 (N,) [s] and errors east, north float64 (N, 2) [m] of the single-point fixes of a recording.

    Raises:
        RealDataError: a file is missing or has another form.
    """
    fixes, _ = read_pos(folder / "rover_1Hz_spp.pos")
    reference = read_reference(folder / "reference.csv")
    frame = LocalFrame(float(reference.lat_rad[0]), float(reference.lon_rad[0]), float(reference.height_m[0]))
    true_m, found_m = reference.enu_m(frame), frame.enu_from_geodetic(fixes.lat_rad, fixes.lon_rad, fixes.height_m)
    at = [np.interp(fixes.t_ns, reference.t_ns, true_m[:, axis]) for axis in (0, 1)]
    return (fixes.t_ns - fixes.t_ns[0]) * 1e-9, found_m[:, :2] - np.stack(at, axis=1)


def fitted(t_s: F64, error_m: F64) -> FittedGnssNoise:
    """The process behind errors float64 (N, 2) [m] at times (N,) [s], at least LAGS_S long."""
    middle = np.median(error_m, axis=0)
    about = error_m - middle
    kept = (np.abs(about) < REFLECTED_M).all(axis=1)
    sigma = float(np.sqrt((about[kept] ** 2).mean()))
    lags, correlation, pairs = _autocorrelation(t_s[kept], about[kept] / sigma)
    (share, time_s), _ = curve_fit(
        lambda lag, a, T: a * np.exp(-lag / T), lags, correlation, (0.7, 10.0), 1 / np.sqrt(pairs),
        bounds=([0.0, 0.5], [1.0, 1e4]),
    )  # fmt: skip
    cep = float(np.median(np.linalg.norm(about, axis=1)))
    constant = float(np.linalg.norm(middle))
    return FittedGnssNoise(sigma, float(time_s), float(share), cep, constant, 1.0 - float(kept.mean()))


def _autocorrelation(t_s: F64, scaled: F64) -> tuple[F64, F64, F64]:
    """Lags 1 … LAGS_S, the mean product at each, and of how many pairs."""
    lag = np.round(np.abs(t_s[:, None] - t_s[None, :])).astype(int)
    product = np.mean(scaled[:, None, :] * scaled[None, :, :], axis=2)
    inside = (lag >= 1) & (lag <= LAGS_S)
    pairs = np.bincount(lag[inside], minlength=LAGS_S + 1)[1:].astype(np.float64)
    total = np.bincount(lag[inside], product[inside], minlength=LAGS_S + 1)[1:]
    there = pairs > 0
    lags = np.arange(1.0, LAGS_S + 1.0)
    return lags[there], np.asarray(total[there] / pairs[there], dtype=np.float64), pairs[there]
