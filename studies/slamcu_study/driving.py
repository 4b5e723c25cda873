"""One drive along the motorway through the pipeline of a vehicle without LiDAR, and what is true of its reports."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.features import merge_layer
from gnd.fleet_sim.roads.drive import RoadDrive
from gnd.fleet_sim.roads.recording import items_of
from gnd.fleet_sim.roads.route import FEATURE_STATES, MAP_ERROR_M, Route
from gnd.fleet_sim.trajectory import gauss_markov
from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.features import FeatureTile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import Detections, DriveItem
from gnd.schemas.feature_layer import LAYERS
from gnd.schemas.features import FeatureChange, FeatureReport
from gnd.vehicle_agent.config import PipelineParameters
from gnd.vehicle_agent.features.layer import FeatureLayer, PlacedLook
from gnd.vehicle_agent.features.layer_parameters import FeatureParameters
from gnd.vehicle_agent.features.layers import look_of
from gnd.vehicle_agent.features.slamcu.camera_pipeline import CameraPipeline
from gnd.vehicle_agent.features.slamcu.replay import PoseAt
from gnd.vehicle_agent.features.slamcu.verdicts import KnownState, NewFeature
from gnd.vehicle_agent.features.slamcu.watched import Lost
from gnd.vehicle_agent.features.view import Occlusion
from gnd.vehicle_agent.pipeline import Output
from gnd.vehicle_agent.report.reporter import Identity
from gnd.vehicle_agent.sources.recording import first_fix
from studies.feature_study.pipelines import TilesAtOnce, found_in, in_route_frame, joined, reports_of, tiles_of
from studies.feature_study.truth import match_one_to_one
from studies.frame.pool import Tick
from studies.slamcu_study.signs import (
    DELETED,
    NEW,
    NORMAL,
    PAPER_LAMBDA_HD,
    MeasuredSigns,
    MergedSigns,
    SignTruth,
    Verdicts,
)

LIDAR_SIGMA: Final = (0.04, 0.04, np.radians(0.08))
"""Errors of the LiDAR localiser's poses, m, m, rad: as `--poses noisy:4cm:0.08deg` of the other studies."""
_LIDAR_TAU_S: Final = 2.0
GIVEN_POSES: Final = ("no_rbpf", "lidar")
_OBSERVE_EVERY: Final = 50
"""Looks: so often the masses of the signs are observed, long before a tile is decided and they are forgotten."""
_SIGNS: Final = LAYERS["signs"]


@dataclass(frozen=True, slots=True, eq=False)
class Driven:
    """What a drive reports, and its poses in the route's frame.

    Attributes:
        reports: as the vehicle sends them; none of a variant that no vehicle drives.
        changes: the reported change of each tile.
        known: the newest that was observed of each sign of the map, with the masses over time.
        new: features that the map has not, at the end of the drive.
        step_ms: float64 (S,), time of each look with the motion since the one before.
        look: int64 (S,), indices of the looks taken.
        path: S poses, as the vehicle believes at the end.
        lost: stretches on which it had believed something else.
    """

    reports: Sequence[FeatureReport]
    changes: Sequence[FeatureChange]
    known: dict[int, KnownState]
    new: tuple[NewFeature, ...]
    step_ms: F64
    look: I64
    path: Sequence[PoseAt]
    lost: Sequence[Lost]


def sign_truth(route: Route) -> SignTruth:
    """Return the signs of a route; its states are `TRUE_CLASSES`, in that order."""
    features = route.features
    codes = np.array([FEATURE_STATES.index(state) for state in features.states], np.uint8)
    return SignTruth(features.feature_id, features.xy_m, codes)


def sign_tiles(route: Route) -> dict[TileId, FeatureTile]:
    """Return the signs of the HD map, normal and deleted ones, as tiles."""
    mapped = route.features.mapped
    return tiles_of(route.frame, mapped.feature_id, mapped.kinds, mapped.mapped_xy_m, MAP_ERROR_M)


def driven_by(drive: RoadDrive, variant: str, vehicle: int, tick: Tick) -> Driven:
    """Return what a drive along a motorway comes to.

    Args:
        drive: along a motorway.
        variant: of `VARIANTS`.
        vehicle: its number, and the seed of its particles.
        tick: called with the number of looks taken.
    """
    if variant in GIVEN_POSES:
        return _with_given_poses(drive, variant, vehicle)
    camera = _camera(drive, vehicle)
    tiles = TilesAtOnce({_SIGNS.name: sign_tiles(drive.route).values()})
    items = items_of(drive) if variant != "no_occlusion" else map(_without_occlusion, items_of(drive))
    return _CameraDrive(drive, camera, tiles, as_printed=variant == "eq_17").run(items, tick)


def _camera(drive: RoadDrive, vehicle: int) -> Identity:
    return Identity(f"car-{vehicle}", drive.route.name, "none", _SIGNS.name)


def _without_occlusion(item: DriveItem) -> DriveItem:
    if not isinstance(item, Detections):
        return item
    return replace(item, free_m=np.empty(0, np.float32), free_field_rad=0.0)


class _CameraDrive:
    """A drive through `CameraPipeline`, which `gnd agent --localise-by slamcu` runs, observed on the way."""

    def __init__(self, drive: RoadDrive, who: Identity, tiles: TilesAtOnce | None, *, as_printed: bool = False) -> None:
        fix, _ = first_fix(items_of(drive), drive.route.name)
        parameters = PipelineParameters(features=FeatureParameters((_SIGNS,)))
        seed = int(who.vehicle.removeprefix("car-"))
        self.pipeline = CameraPipeline(fix, parameters, who, feature_tiles=tiles, seed=seed)
        self._drive, self._known, self._as_printed = drive, dict[int, KnownState](), as_printed

    def run(self, items: Iterator[DriveItem], tick: Tick) -> Driven:
        """Drive to the end."""
        pipeline, outputs, seen, spent_s = self.pipeline, list[Output](), 0, 0.0
        step_ms, look = list[float](), list[int]()
        for item in items:
            begun_s = perf_counter()
            outputs.append(pipeline.push(item))
            spent_s += perf_counter() - begun_s
            if self._as_printed and pipeline.slamcu is not None:
                pipeline.slamcu.weigh_as_printed()
                self._as_printed = False  # once is enough
            if not isinstance(item, Detections):
                continue
            seen += 1
            if pipeline.slamcu is not None and len(pipeline.slamcu.path) > len(look):
                look.append(seen - 1)
                step_ms.append(1e3 * spent_s)
            spent_s = 0.0
            if seen % _OBSERVE_EVERY == 0:
                self._observe()
                tick(seen, len(self._drive.looks))
        self._observe()
        outputs.append(pipeline.finish())
        slamcu = pipeline.slamcu
        assert slamcu is not None, "the vehicle never found its first pose"
        T = self._drive.route.frame.T_self_other(pipeline.place.frame)
        new = tuple(replace(one, position_m=T[:2, :2] @ one.position_m + T[:2, 3]) for one in slamcu.new_features())
        reports = reports_of(outputs)
        changes = [change for report in reports for change in report.tiles]
        path = [_moved(one, T) for one in slamcu.path]
        return Driven(reports, changes, self._known, new, np.array(step_ms), np.array(look), path, slamcu.lost)

    def _observe(self) -> None:
        if self.pipeline.slamcu is not None:
            self._known |= {one.feature_id: one for one in self.pipeline.slamcu.known_states()}


def _moved(one: PoseAt, T: F64) -> PoseAt:
    """A pose in the frame of T (4, 4), which stands upright."""
    R = np.eye(3)
    R[:2, :2] = T[:2, :2]
    return PoseAt(one.t_s, R @ one.pose + [*T[:2, 3], np.arctan2(T[1, 0], T[0, 0])], R @ one.cov @ R.T)


def _with_given_poses(drive: RoadDrive, variant: str, vehicle: int) -> Driven:
    """The signs as a vehicle judges them whose poses come from elsewhere: `FeatureLayer`, as behind the LiDAR."""
    layer, route = FeatureLayer(_SIGNS, drive.route.frame), drive.route
    for tile in sign_tiles(route).values():
        layer.hold(tile)
    poses = _lidar_poses(drive, vehicle) if variant == "lidar" else _blind_poses(drive, vehicle)
    looks = [item for item in items_of(drive) if isinstance(item, Detections)]
    step_ms = []
    for i, at in poses.items():
        begun_s, rows = perf_counter(), np.arange(len(looks[i].kinds))
        placed = PlacedLook(look_of(looks[i], rows, np.eye(4)), at.pose, at.cov, 0.0)
        layer.see(placed, Occlusion.of_look(looks[i]))
        step_ms.append(1e3 * (perf_counter() - begun_s))
    return Driven((), layer.leave_all(), {}, (), np.array(step_ms), np.array(list(poses)), list(poses.values()), ())


def _lidar_poses(drive: RoadDrive, vehicle: int) -> dict[int, PoseAt]:
    rng = np.random.default_rng([vehicle, drive.seed, 61])
    n, step_s = len(drive.looks), 1.0 / drive.view.rate_hz
    error = np.stack([gauss_markov(rng, n, step_s, sigma, _LIDAR_TAU_S) for sigma in LIDAR_SIGMA], axis=1)
    cov = np.diag(np.square(LIDAR_SIGMA))
    return {i: PoseAt(i * step_s, pose, cov) for i, pose in enumerate(drive.truth.look_poses + error)}


def _blind_poses(drive: RoadDrive, vehicle: int) -> dict[int, PoseAt]:
    """The poses of a pipeline whose camera sees nothing: wheels, gyro and GNSS alone."""
    blind = _CameraDrive(drive, _camera(drive, vehicle), None)
    driven = blind.run((_seeing_nothing(item) for item in items_of(drive)), lambda *_: None)
    return dict(zip(driven.look.tolist(), driven.path, strict=True))


def _seeing_nothing(item: DriveItem) -> DriveItem:
    if not isinstance(item, Detections):
        return item
    none = item.range_m[:0]
    return replace(
        item, kinds=(), range_m=none, bearing_rad=none, height_m=none, sigma_range_m=none, sigma_bearing_rad=none
    )


def verdicts_of(drive: RoadDrive, driven: Driven) -> Verdicts:
    """Return a drive's verdicts on the signs by its reports, and what the truth adds to them.

    A sign of the map that no report mentions stays on the map: it counts as normal.
    """
    truth, frame = sign_truth(drive.route), drive.route.frame
    seen = [one for change in driven.changes for one in change.seen]
    absent = {one.feature_id for one in seen if one.existence.absent > one.existence.exist}
    known = drive.route.features.mapped.feature_id
    new_xy_m, new_cov_m2 = found_in(frame, driven.changes)
    pose, cov = np.array([one.pose for one in driven.path]), np.array([one.cov for one in driven.path])
    true = drive.truth.look_poses[driven.look]
    in_view, hidden = drive.truth.in_view[driven.look], drive.truth.hidden[driven.look]
    sign, masses = _traces(driven, truth)
    return Verdicts(
        known_id=known,
        known_predicted=np.array([DELETED if one in absent else NORMAL for one in known.tolist()], np.uint8),
        new_xy_m=new_xy_m,
        new_cov_m2=new_cov_m2,
        step_ms=driven.step_ms,
        pose_error=pose_errors(pose, true),
        pose_chi2=pose_chi2(pose, cov, true),
        pose_given_up=given_up(driven),
        lost=np.array(
            [(one.from_s, one.until_s, one.off_m, one.value, one.taken_back, one.replayed) for one in driven.lost]
        ).reshape(-1, 6),
        visible=(in_view & ~hidden).sum(axis=0).astype(np.int64),
        occluded=(in_view & hidden).sum(axis=0).astype(np.int64),
        trace_sign=sign,
        trace_masses=masses,
    )


def pose_errors(pose: F64, true: F64) -> F64:
    """Return errors (S, 3) of poses (S, 3): along and to the left of the true heading [m], heading [rad]."""
    dx, dy = (pose - true)[:, :2].T
    c, s = np.cos(true[:, 2]), np.sin(true[:, 2])
    turn = (pose[:, 2] - true[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return np.column_stack([c * dx + s * dy, c * dy - s * dx, turn])


def pose_chi2(pose: F64, cov: F64, true: F64) -> F64:
    """Return (S,) squared Mahalanobis distances of poses' places from the true ones; (S, 3), (S, 3, 3), (S, 3)."""
    off = (pose - true)[:, :2]
    return np.asarray(np.einsum("si,si->s", off, np.linalg.solve(cov[:, :2, :2], off[..., None])[..., 0]))


def given_up(driven: Driven) -> NDArray[np.bool_]:
    """Return bool (S,), the looks of stretches that the vehicle has given up."""
    t_s, lost = np.array([one.t_s for one in driven.path]), np.zeros(len(driven.path), np.bool_)
    for one in driven.lost:
        lost |= (t_s >= one.from_s) & (t_s <= one.until_s) & (not one.replayed)
    return lost


def _traces(driven: Driven, truth: SignTruth) -> tuple[I64, F64]:
    """Masses over time of deleted and new signs, those of the map from λ_HD on: sign (Q,), masses (Q, 3)."""
    rows = []
    for sign, one in _observed(driven, truth):
        if isinstance(one, KnownState) and one.history:
            rows.append((sign, PAPER_LAMBDA_HD, 0.0, 1.0 - PAPER_LAMBDA_HD))
        rows += [(sign, at.existence.exist, at.existence.absent, at.existence.unknown) for at in one.history]
    columns = np.array(rows, np.float64).reshape(-1, 4)
    return columns[:, 0].astype(np.int64), columns[:, 1:]


def _observed(driven: Driven, truth: SignTruth) -> Iterator[tuple[int, KnownState | NewFeature]]:
    """Deleted and new signs with what was observed of them."""
    for sign in truth.of(DELETED).tolist():
        if int(truth.feature_id[sign]) in driven.known:
            yield sign, driven.known[int(truth.feature_id[sign])]
    signs = truth.of(NEW)
    matching = match_one_to_one(np.array([one.position_m for one in driven.new]).reshape(-1, 2), truth.xy_m[signs])
    for sign, estimate in zip(signs[matching.true].tolist(), matching.estimate.tolist(), strict=True):
        yield sign, driven.new[estimate]


def merged_signs(route: Route, reports: Sequence[FeatureReport]) -> MergedSigns:
    """Return what the cloud publishes."""
    base = {tile: one.features for tile, one in sign_tiles(route).items()}
    before = {one.feature_id for features in base.values() for one in features}
    merged = {tile: one.features for tile, one in merge_layer(base, reports).items()}
    known = _joined_signs(
        (one.feature_id, in_route_frame(route.frame, tile, [(one.position_m, one.cov_m2)]))
        for tile, features in merged.items()
        for one in features
        if one.feature_id in before
    )
    places = joined(
        in_route_frame(route.frame, tile, [(f.position_m, f.cov_m2) for f in features if f.feature_id not in before])
        for tile, features in merged.items()
    )
    return MergedSigns(known.feature_id, *places, known)


def measured_signs(route: Route, reports: Sequence[FeatureReport]) -> MeasuredSigns:
    """Return the signs of the map as one vehicle's reports have them, independently of the map."""
    return _joined_signs(
        (one.feature_id, in_route_frame(route.frame, change.tile, [(one.position_m, one.cov_m2)]))
        for report in reports
        for change in report.tiles
        for one in change.seen
        if one.position_m is not None and one.cov_m2 is not None
    )


def _joined_signs(signs: Iterable[tuple[int, tuple[F64, F64]]]) -> MeasuredSigns:
    """Signs with their places (1, 2), (1, 2, 2), in the order of their ids."""
    by_id = sorted(signs, key=lambda one: one[0])
    return MeasuredSigns(np.array([one[0] for one in by_id], np.int64), *joined(place for _, place in by_id))
