"""A straight flat road with borders, as scans of a LiDAR and looks of a camera show it to the lane mapper."""

from collections.abc import Sequence

import numpy as np

from gnd.cloud_merger.features import FeatureMergeParameters, merge_layer
from gnd.gnd_map.features import Feature, FeatureTile, feature_id_of, prior
from gnd.gnd_map.features.lane_pieces import lane_pieces
from gnd.gnd_map.geodesy import LocalFrame
from gnd.schemas.feature_change import FeatureChange
from gnd.schemas.features import FeatureReport
from gnd.schemas.report_id import deterministic_report_id
from gnd.vehicle_agent.features.lanes.lane_mapper import MARKINGS, LaneMapper
from gnd.vehicle_agent.features.lanes.looks import BorderLook
from gnd.vehicle_agent.features.lanes.paint import PaintLook

FRAME = LocalFrame(np.radians(49.0), np.radians(8.4), 100.0)
HEADING = np.radians(25.0)
LENGTH_M = 120.0
BORDERS = ((-3.5, "solid"), (0.0, "dashed"), (3.5, "solid"))
Border = tuple[float, str]


def rings(borders=BORDERS, seam_y=None, wet=False, noise=0.1, seed=0, asphalt=20.0):
    """One scan of eight rings on a flat road: points (N, 3) in the vehicle frame, intensity, ring."""
    rng = np.random.default_rng(seed)
    points, intensity, ring = [], [], []
    for number, radius in enumerate((4.0, 5.0, 6.5, 8.0, 10.0, 12.0, 14.5, 18.0)):
        azimuth = np.arange(-np.pi, np.pi, np.radians(0.2))
        xyz = np.column_stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.zeros(len(azimuth))])
        base = asphalt * (6.0 / radius) ** 2 * (0.7 + 0.1 * number)
        bright = np.zeros(len(azimuth))
        for y, marking in borders:
            on = np.abs(xyz[:, 1] - y) < 0.07
            bright = np.maximum(bright, on if marking == "solid" else on & (xyz[:, 0] % 9.0 < 3.0))
        if seam_y is not None:
            bright = np.maximum(bright, np.abs(xyz[:, 1] - seam_y) < 0.012)
        shine = 0.1 if wet else 3.0
        value = base * (1.0 + shine * bright) * (1.0 + noise * rng.standard_normal(len(azimuth)))
        points.append(xyz + 0.01 * rng.standard_normal(xyz.shape))
        intensity.append(np.maximum(value, 0.0))
        ring.append(np.full(len(azimuth), number))
    return np.concatenate(points), np.concatenate(intensity), np.concatenate(ring)


def pose(x: float, y: float, off: float = 0.0):
    """(4, 4) of a vehicle on the road, along it; `off` to the left."""
    c, s = np.cos(HEADING), np.sin(HEADING)
    T = np.eye(4)
    T[:2, :2] = [[c, -s], [s, c]]
    T[:2, 3] = T[:2, :2] @ (x, y + off)
    return T


def in_map(x, y):
    """(N, 3) places on the road in the map frame."""
    return np.column_stack([x, y, np.zeros(len(x))]) @ pose(0.0, 0.0)[:3, :3].T


def drive(
    borders: Sequence[Border] = BORDERS,
    held: Sequence[FeatureTile] = (),
    off: float = 0.0,
    camera_off: float | None = None,
    lidar: bool = True,
    wet: bool = False,
    seed: int = 0,
) -> LaneMapper:
    """A drive along the road, whose poses are `off` to the left of where the vehicle is."""
    rng = np.random.default_rng(seed)
    mapper = LaneMapper(FRAME, 0.03)
    for tile in held:
        mapper.hold(tile)
    for x in np.arange(-LENGTH_M / 2, LENGTH_M / 2, 1.0):
        if lidar:
            mapper.see_paint(_paint(borders, x, rng, wet), pose(x, -1.75, off))
        if camera_off is not None:
            mapper.see_borders(_borders(borders, camera_off, rng), pose(x + 0.5, -1.75, off))
    return mapper


def _paint(borders, x0, rng, wet) -> PaintLook:
    x = np.concatenate([np.arange(-15.0, -4.0, 1.5), np.arange(4.0, 15.0, 1.5)]) + rng.uniform(-0.7, 0.7)
    runs = [np.zeros((0, 3))]
    for y, marking in () if wet else borders:
        keep = np.full(len(x), True) if marking == "solid" else (x + x0) % 9.0 < 3.0
        across = y + 1.75 + rng.normal(0.0, 0.03, keep.sum())
        runs.append(np.column_stack([x[keep], across, np.zeros(keep.sum())]))
    every = np.concatenate(runs)
    gx, gy = np.meshgrid(np.arange(-15.0, 15.0, 0.5), np.arange(-4.0, 8.0, 0.5))
    return PaintLook(every, np.full(len(every), 0.12), np.column_stack([gx.ravel(), gy.ravel(), np.zeros(gx.size)]))


def _borders(borders, off, rng) -> BorderLook:
    x = np.arange(4.0, 16.0, 1.0)
    xy = [np.column_stack([x, np.full(len(x), y + 1.75 + off) + rng.normal(0.0, 0.05)]) for y, _ in borders]
    line = np.repeat(np.arange(len(borders)), len(x))
    return BorderLook(np.concatenate(xy), line, tuple(marking for _, marking in borders), ("white",) * len(borders))


def tiles_of(borders: Sequence[Border] = BORDERS, off: float = 0.0) -> list[FeatureTile]:
    """The road's borders as the first version of the layer."""
    found: dict = {}
    for number, (y, marking) in enumerate(borders):
        x = np.arange(-LENGTH_M / 2 - 20.0, LENGTH_M / 2 + 20.0, 5.0)
        for piece in lane_pieces(*FRAME.geodetic_from_enu(in_map(x, np.full(len(x), y + off)))):
            told = (("border", str(number + 1)), ("subtype", marking))
            one = Feature(
                feature_id_of("piece", number, *piece.cell), "lane_marking", piece.points_m,
                np.array([0.01, 0.0, 0.0, 0.01, 0.0, 0.01]), prior(0.95), told,
            )  # fmt: skip
            found.setdefault(piece.tile, []).append(one)
    return [FeatureTile.of(tile, 1, some) for tile, some in sorted(found.items())]


def report_of(changes: Sequence[FeatureChange], vehicle: int) -> list[FeatureReport]:
    """What a drive reports, one report a district, after its journey."""
    reports = []
    for district in sorted({change.tile.district for change in changes}, key=str):
        mine = tuple(sorted((one for one in changes if one.tile.district == district), key=lambda one: one.tile))
        name = deterministic_report_id(1_600_000_000_000 + vehicle * 3_600_000, f"car-{vehicle}", district.path)
        made = FeatureReport(
            name, f"car-{vehicle}", "VLP-16", "test", MARKINGS.name, district, 1, 2 + vehicle, mine
        )  # fmt: skip
        reports.append(FeatureReport.decode(made.encode()))
    return reports


def merged(drives: Sequence[LaneMapper], epochs: Sequence[FeatureTile] = ()) -> dict:
    """What the cloud publishes of several drives."""
    reports = [one for k, mapper in enumerate(drives) for one in report_of(mapper.leave_all(), k)]
    parameters = FeatureMergeParameters().of_layer(MARKINGS)
    before = {tile.tile_id: tile.features for tile in epochs}
    return {tile: one.features for tile, one in merge_layer(before, reports, parameters).items()}


def across(tile, feature) -> float:
    """How far left of the road's middle a piece lies."""
    T = FRAME.T_self_other(LocalFrame.of_tile(tile))
    middle = T[:3, :3] @ feature.points_m.mean(axis=0) + T[:3, 3]
    return float((np.linalg.inv(pose(0.0, 0.0)[:3, :3]) @ middle)[1])
