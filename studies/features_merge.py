"""Reports about features merged per second, with the accuracy and the honesty of what comes out beside it.

Streetlights every 40 m along a road, found by vehicles whose drives are off as a whole by metres along the road and by
decimetres across it, as low-cost GNSS with lanes leaves them, and each light by decimetres more.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from time import process_time
from typing import Final

import numpy as np

from gnd.cloud_merger.features import FeatureMergeParameters, MergedFeatures, merge_features, merge_layer
from gnd.cloud_merger.features.window import LayerMerger, LayerState, LayerWindow
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features import Feature, full_covariance, geodetic_in_tile, hit, miss, points_in_tile
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.features import EVERY_CELL, FeatureChange, FeatureReport, Found
from gnd.schemas.report_id import deterministic_report_id
from studies.frame.measure import Figure, least_s

ROAD_M: Final = 3_000
SPACING_M: Final = 40.0
ALONG_M: Final = 3.0
ACROSS_M: Final = 0.4
EACH_M: Final = 0.3
VEHICLES: Final = 11
SEEN_SHARE: Final = 0.9
BUSY_REPORTS: Final = 256
JOURNAL_REPORTS: Final = 9_984
WINDOW_REPORTS: Final = 32
SEEDS: Final = range(11, 16)
T0_MS: Final = 1_700_000_000_000
FRAME: Final = LocalFrame(0.651, 2.2165)
Merged = dict[TileId, MergedFeatures]


def run() -> list[Figure]:
    """Measure a road, tile by tile, and one tile that many vehicles have reported on."""
    reports = reports_of(lights(), VEHICLES, seed=SEEDS[0])
    spent_s = least_s(lambda: merge_layer({}, reports))
    n = sum(len(change.found) for report in reports for change in report.tiles)
    busy = _busy_tile()
    (tile,) = {report.tiles[0].tile for report in busy}
    each_s = least_s(lambda: merge_features(tile, (), busy))
    detail = f"{VEHICLES} vehicles, {ROAD_M / 1000:g} km, {n} finds"
    return [
        Figure("whole road", n / spent_s, "finds/s", f"{detail} in {spent_s:.2f} s of one core, tiles around told"),
        Figure(
            "busy tile",
            len(busy) / each_s,
            "reports/s",
            f"{len(busy)} reports on one tile in {each_s:.2f} s of one core",
        ),
        *_long_journal(),
        *_quality(),
    ]


def lights() -> F64:
    """Return (N, 2) streetlights along a gentle curve, metres in `FRAME`."""
    return _road(SPACING_M)


def _road(step_m: float) -> F64:
    along = np.arange(0.0, ROAD_M, step_m)
    return np.column_stack([along, along**2 / 6_000.0])


def _tiles_of(xy_m: F64) -> list[TileId]:
    lat, lon, _ = FRAME.geodetic_from_enu(np.column_stack([xy_m, np.zeros(len(xy_m))]))
    return [TileId.from_geodetic(float(a), float(b)) for a, b in zip(lat, lon, strict=True)]


def reports_of(truth_m: F64, vehicles: int, seed: int) -> list[FeatureReport]:
    """Return what each vehicle reports of the lights, a report a district."""
    rng = np.random.default_rng([seed, vehicles])
    return [report for vehicle in range(vehicles) for report in _drive(truth_m, vehicle, rng)]


def _drive(truth_m: F64, vehicle: int, rng: np.random.Generator) -> list[FeatureReport]:
    shift_m = rng.normal(0.0, [ALONG_M, ACROSS_M])
    at_m = truth_m + shift_m + rng.normal(0.0, EACH_M, truth_m.shape)
    at_m = at_m[rng.random(len(at_m)) < SEEN_SHARE]
    cov_m2 = np.array([ALONG_M**2 + EACH_M**2, 0.0, 0.0, ACROSS_M**2 + EACH_M**2, 0.0, 1e4])
    by_tile: dict[TileId, list[Found]] = {tile: [] for tile in _tiles_of(_road(5.0))}  # all of the road was viewed
    for lat, lon, height in zip(*FRAME.geodetic_from_enu(np.column_stack([at_m, np.zeros(len(at_m))])), strict=True):
        tile = TileId.from_geodetic(float(lat), float(lon))
        by_tile.setdefault(tile, []).append(
            Found("streetlight", points_in_tile(tile, lat, lon, height), cov_m2, hit(0.99), 5)
        )
    return [
        _report(f"car-{vehicle}", vehicle, [(tile, by_tile[tile]) for tile in tiles])
        for tiles in _by_district(sorted(by_tile))
    ]


def _by_district(tiles: Sequence[TileId]) -> list[list[TileId]]:
    grouped: dict[str, list[TileId]] = defaultdict(list)
    for tile in tiles:
        grouped[tile.district.path].append(tile)
    return list(grouped.values())


def _report(vehicle: str, number: int, tiles: Sequence[tuple[TileId, list[Found]]]) -> FeatureReport:
    district = tiles[0][0].district
    changes = tuple(FeatureChange(tile, 0, b"", EVERY_CELL, (), tuple(found)) for tile, found in tiles)
    name = deterministic_report_id(T0_MS + number, vehicle, district.path)
    return FeatureReport(name, vehicle, "camera", "benchmark", "streetlights", district, 0, 1, changes)


def _busy_tile() -> list[FeatureReport]:
    """Many reports on one tile: four lights in it, found by 64 vehicles again and again."""
    rng = np.random.default_rng(11)
    tile = TileId.from_geodetic(FRAME.lat_rad, FRAME.lon_rad)
    truth_m = np.array([[-8.0, -8.0], [8.0, -8.0], [-8.0, 8.0], [8.0, 8.0]])
    cov_m2 = np.array([0.09, 0.0, 0.0, 0.09, 0.0, 1e4])
    reports = []
    for n in range(BUSY_REPORTS):
        at_m = truth_m + rng.normal(0.0, 0.3, truth_m.shape)
        sure = [hit(0.99) if rng.random() < SEEN_SHARE else miss(0.5) for _ in at_m]
        found = [
            Found("streetlight", np.array([[*at, 0.0]]), cov_m2, says, 5) for at, says in zip(at_m, sure, strict=True)
        ]
        reports.append(_report(f"car-{n % 64}", n, [(tile, found)]))
    return reports


def _long_journal() -> list[Figure]:
    """What a report costs after thousands, each merged when it comes into windows of 32; and what is remembered."""
    begun, tile = _busy_tile(), TileId.from_geodetic(FRAME.lat_rad, FRAME.lon_rad)
    parameters = FeatureMergeParameters()
    merger = LayerMerger(tile, parameters, {}, {})
    state, spent_s, sizes = LayerState(()), [], []
    for number in range(JOURNAL_REPORTS // WINDOW_REPORTS):
        first = number * WINDOW_REPORTS
        reports = [_later(begun[k % len(begun)], k) for k in range(first, first + WINDOW_REPORTS)]
        is_timed = not 2 <= number < JOURNAL_REPORTS // WINDOW_REPORTS - 2
        start_s = process_time()
        for n in range(1, WINDOW_REPORTS) if is_timed else ():
            merger.merge(state, LayerWindow(tuple(reports[:n]), 1))
        window = LayerWindow(tuple(reports), 1)
        state = merger.fold(state, merger.merge(state, window), window)
        if is_timed:
            spent_s.append(process_time() - start_s)
        sizes.append(len(state.encoded(number).memory))
    each_ms = 1e3 / WINDOW_REPORTS * np.array(spent_s)
    return [
        Figure("late report", float(each_ms[-2:].sum() / each_ms[:2].sum()), "",
               f"CPU of the last 64 of {JOURNAL_REPORTS} reports to the first 64, {each_ms[0]:.1f} ms each at first"),
        Figure("memory", sizes[-1] / 1e3, "kB", f"of a tile of four lights, {sizes[9] / 1e3:.2f} kB after 320 reports"),
    ]  # fmt: skip


def _later(report: FeatureReport, number: int) -> FeatureReport:
    """The same by another vehicle, one of 700."""
    name = deterministic_report_id(T0_MS + number, "later")
    return replace(report, report_id=name, vehicle=f"car-{number % 700}")


def _quality() -> list[Figure]:
    """Accuracy of what is published after so many vehicles, over all seeds."""
    truth_m, figures = lights(), []
    for vehicles, gain in ((6, 1.25), (VEHICLES, 1.25), (VEHICLES, 1.0)):
        parameters = FeatureMergeParameters(renewal_gain=gain)
        scores = [_score(truth_m, merge_layer({}, reports_of(truth_m, vehicles, s), parameters)) for s in SEEDS]
        error_m, nees, published = np.mean(scores, axis=0).tolist()
        figures.append(
            Figure(
                f"error after {vehicles}",
                error_m,
                "m",
                f"mean of {len(SEEDS)} seeds, renewal gain {gain:g}; {published:.1f} published of {len(truth_m)}, "
                f"NEES {nees:.2f} of 2",
            )
        )
    return figures


def _score(truth_m: F64, merged: Merged) -> tuple[float, float, int]:
    """Mean error and mean normalised squared error of the published lights, against the nearest of the truth."""
    placed = [(*_in_frame(tile, one), one) for tile, each in merged.items() for one in each.features]
    errors = [truth_m[np.hypot(*(truth_m - at).T).argmin()] - at for at, *_ in placed]
    squares = [e @ np.linalg.solve(cov, e) for e, (_, cov, _) in zip(errors, placed, strict=True)]
    return float(np.mean(np.hypot(*np.array(errors).T))), float(np.mean(squares)), len(placed)


def _in_frame(tile: TileId, feature: Feature) -> tuple[F64, F64]:
    at_m = FRAME.enu_from_geodetic(*geodetic_in_tile(tile, feature.points_m))[0, :2]
    return at_m, full_covariance(feature.cov_m2)[:2, :2]
