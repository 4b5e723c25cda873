"""How well poles are found: simulated streets against their truth, and real scans against the scans after them.

A post counts as observable when at least 6 returns lie on it that span at least 1.5 m upwards; lamps, signs and trees
are the posts that stand alone, posts of scaffolds are counted apart, bollards are too low. A detection is right where a
post of any kind, a scaffold's or a bollard too, stands within 0.5 m. Single scans, and windows of five scans over two
seconds whose places are wrong by 4 cm and 0.08° (one standard deviation, drawn for each scan). Traffic and people are
on the street. Worlds and drives were not used for tuning. Recordings have no labels: the share of the poles within 30 m
that the next scan finds again within 0.3 m.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import radians
from pathlib import Path
from time import process_time
from typing import Final

import numpy as np

from gnd.fleet_sim.sensors import SHORT_NAMES
from gnd.gnd_map.se3 import exp_so3, transform
from gnd.vehicle_agent.features.poles.detector import PoleDetector, Rays
from gnd.vehicle_agent.features.poles.slices import PoseSigma
from studies.frame.measure import Figure
from studies.frame.options import check, option, seeds
from studies.pole_real import draw_poles, poles_of, scans_of, stability
from studies.pole_scenes import BANDS, CHI2_2_95, KINDS, SINGLE, PoleDrive, PoleScan, PoleScans, PoleScore

RECORDINGS: Final = Path(__file__).resolve().parents[2] / "shared" / "data"
FOLDERS: Final = ("kitti_raw_0060", "kitti00_start16", "radiate_fog", "apollo_ndt")
PICTURES_OF: Final = 3
"""Scans of each recording that are drawn: the first, one in the middle, the last."""
SENSORS: Final = ("vlp16", "hdl32e", "hdl64e")
SEEDS: Final = (201, 202, 203)
STARTS_S: Final = (3.0, 6.5, 10.0, 13.5, 17.0)
WINDOW_SCANS, WINDOW_STEP_S = 5, 0.5
SIGMA_M, SIGMA_RAD = 0.04, radians(0.08)


@dataclass(frozen=True, slots=True)
class PoleOptions:
    """Simulated streets and real recordings."""

    seeds: tuple[int, ...] = seeds(*SEEDS, text="Worlds of the streets.")
    sensors: tuple[str, ...] = option(
        SENSORS,
        f"Some of {', '.join(SHORT_NAMES)}, or none.",
        known=SHORT_NAMES,
        some=False,
        read=lambda text: tuple(name for name in text.split(",") if name and name != "none"),
    )
    recordings: Path = option(RECORDINGS, f"Folder with {', '.join(FOLDERS)}.")
    pictures: Path | None = option(None, "Draw what is found in real scans into this folder.")

    def __post_init__(self) -> None:
        check(self)


OPTIONS: Final = PoleOptions


def run(chosen: PoleOptions | None = None) -> list[Figure]:
    """Measure every sensor, then every recording that there is."""
    chosen = chosen or PoleOptions()
    figures: list[Figure] = []
    for sensor in chosen.sensors:
        single, window = measured(sensor, chosen.seeds)
        figures += [*_by_range(sensor, single), *_figures(sensor, single), *_figures(f"{sensor}, window", window)]
    for name in FOLDERS:
        figures += _recording(chosen.recordings / name, chosen.pictures)
    return figures


def measured(sensor: str, seeds: Sequence[int], starts_s: Sequence[float] = STARTS_S) -> tuple[PoleScore, PoleScore]:
    """Scores of single scans and of windows."""
    single, window = PoleScore(), PoleScore()
    for seed in seeds:
        times = tuple(start + WINDOW_STEP_S * k for start in starts_s for k in range(WINDOW_SCANS))
        drive = PoleDrive(PoleScans(seed, SHORT_NAMES[sensor], times))
        rng, held = np.random.default_rng(seed), list[PoleScan]()
        for scan in drive.scans():
            held.append(scan)
            if len(held) == WINDOW_SCANS:
                middle = held[WINDOW_SCANS // 2]
                _add(single, [middle.rays], [middle], drive, middle)
                _add(window, [_misplaced(one, rng) for one in held], held, drive, middle)
                held.clear()
    return single, window


def _add(score: PoleScore, rays: Sequence[Rays], scans: Sequence[PoleScan], drive: PoleDrive, here: PoleScan) -> None:
    start_s = process_time()
    poles = PoleDetector().window(rays, here.T_map_vehicle[:3, 3])
    score.spent_s.append(process_time() - start_s)
    observable = np.logical_or.reduce([scan.observable for scan in scans])
    score.add(poles, drive.posts, observable, here.T_map_vehicle[:2, 3])


def _misplaced(scan: PoleScan, rng: np.random.Generator) -> Rays:
    """The scan as a localiser would place it."""
    T, error = scan.T_map_vehicle, np.eye(4)
    error[:3, :3], error[:3, 3] = exp_so3(SIGMA_RAD * rng.standard_normal(3)), SIGMA_M * rng.standard_normal(3)
    moved = T @ error @ np.linalg.inv(T)
    ends, starts = (transform(moved, points) for points in (scan.rays.points_m, scan.rays.origins_m))
    return Rays(ends, starts, PoseSigma(SIGMA_M, SIGMA_RAD))


def _by_range(name: str, score: PoleScore) -> Iterator[Figure]:
    for band, (low, high) in enumerate(BANDS):
        recall, n = score.recall(band)
        precision, detections = score.precision(band)
        parts = ", ".join("{} {:.0f} % of {}".format(s, *score.recall(band, [s])) for s in (*SINGLE, "scaffold"))
        yield Figure(f"found, {name}, {low} to {high} m", recall, "%", f"of {n} observable; {parts}")
        yield Figure(f"right, {name}, {low} to {high} m", precision, "%", f"of {detections} detections")


def _figures(name: str, score: PoleScore) -> Iterator[Figure]:
    recall, n = score.recall()
    of_all, everything = score.recall_of_all()
    precision, detections = score.precision()
    error_m, nees = np.array(score.errors_m), np.array(score.nees)
    spread = float(np.std(score.diameters_m))
    yield Figure(f"found, {name}", recall, "%", f"of {n} observable; {of_all:.0f} % of all {everything} within 40 m")
    yield Figure(f"right, {name}", precision, "%", f"of {detections} detections")
    yield Figure(f"off, {name}, median", 100 * float(np.median(error_m)), "cm",
                 f"95 %: {100 * np.quantile(error_m, 0.95):.1f} cm")  # fmt: skip
    yield Figure(
        f"NEES, {name}", float(nees.mean()), "", f"2 expected; {100 * np.mean(nees < CHI2_2_95):.0f} % within 95 %"
    )
    yield Figure(
        f"diameter, {name}", 100 * float(np.mean(score.diameters_m)), "cm", f"mean error; spread {100 * spread:.1f} cm"
    )
    for source in (*SINGLE, "scaffold"):
        told_as = Counter({kind: k for (s, kind), k in score.kinds.items() if s == source})
        share = 100 * told_as[KINDS.get(source, "pole")] / max(sum(told_as.values()), 1)
        yield Figure(
            f"kind of {source}, {name}", share, "%", ", ".join(f"{kind} {k}" for kind, k in told_as.most_common())
        )
    yield Figure(f"time, {name}", 1e3 * float(np.median(score.spent_s)), "ms", "of one core, median")


def _recording(folder: Path, pictures: Path | None) -> Iterator[Figure]:
    if not folder.is_dir():
        yield Figure(f"found again, {folder.name}", float("nan"), "%", "recording not there")
        return
    scans, detector = scans_of(folder), PoleDetector()
    poles_of(scans[0], detector)
    start_s = process_time()
    result = stability(scans, detector)
    each_ms = 1e3 * (process_time() - start_s) / len(scans)
    detail = f"of {result.asked}; {result.found / result.scans:.1f} a scan, {result.scans} scans, {each_ms:.1f} ms each"
    yield Figure(f"found again, {folder.name}", 100 * result.share, "%", detail)
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        for k in sorted({round(f * (len(scans) - 1)) for f in np.linspace(0.0, 1.0, PICTURES_OF)}):
            scan = scans[k]
            draw_poles(scan, poles_of(scan, detector), f"{folder.name}, scan {scan.number}",
                       pictures / f"{folder.name}_{scan.number}.png")  # fmt: skip
