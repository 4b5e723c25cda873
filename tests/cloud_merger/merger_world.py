"""Small tiles and reports for the tests of the merger."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from zlib import crc32

import numpy as np

from gnd.cloud_merger.confirmation import ConfirmationParameters
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile, content_sha
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.report_id import deterministic_report_id

TILE = TileId(497353963154)  # Figure 2 of the paper
NEIGHBOUR = TileId(497353963155)

VOXEL_BY_VOXEL = ConfirmationParameters(together_voxels=1)
"""These tiles are a few voxels: one is no less than what comes or goes in a street."""

# A state of a voxel: mean (3) and standard deviations along x, y, z (3), in metres.
State = tuple[float, float, float, float, float, float]
GROUND: State = (0.0, 0.0, -0.2, 0.28, 0.28, 0.02)
GROUND_AGAIN: State = (0.01, -0.02, -0.19, 0.27, 0.28, 0.02)
WALL: State = (0.3, 0.0, 0.0, 0.02, 0.28, 0.28)
WALL_AGAIN: State = (0.29, 0.03, 0.0, 0.02, 0.27, 0.28)
POLE: State = (-0.3, 0.2, 0.0, 0.03, 0.03, 0.28)
BALL: State = (0.0, 0.0, 0.2, 0.2, 0.2, 0.2)


def gaussians_of(states: Mapping[int, State | None], count: int = 200, cells: int = 60) -> Gaussians:
    """A Gaussian a voxel; None: count 0."""
    ids = sorted(states)
    there = np.array([states[i] is not None for i in ids], bool)
    rows = np.array([states[i] or (0.0,) * 6 for i in ids], np.float64).reshape(-1, 6)
    cov = np.zeros((len(ids), 6), np.float32)
    cov[:, [0, 3, 5]] = rows[:, 3:] ** 2
    return Gaussians(
        np.array(ids, np.int32),
        np.where(there, count, 0).astype(np.int32),
        np.where(there, cells, 0).astype(np.int32),
        rows[:, :3].astype(np.float32),
        cov,
    )


def seen_by(vehicle: str, states: Mapping[int, State | None]) -> dict[int, State | None]:
    """The states as one vehicle measures them: no two measure the same to the bit."""
    n = crc32(vehicle.encode())
    off = 0.01 * (n % 11 - 5), 0.01 * (n // 11 % 11 - 5)
    return {
        voxel: None if state is None else (state[0] + off[0], state[1] + off[1], *state[2:])
        for voxel, state in states.items()
    }


def measured_anew(vehicle: str, change: TileChange) -> TileChange:
    """The change as another vehicle measures it."""
    off = np.float32(0.001 * (crc32(vehicle.encode()) % 100))
    mean_m = change.changed.mean_m + off * change.changed.exists[:, None]
    return replace(change, changed=replace(change.changed, mean_m=mean_m.astype(np.float32)))


def sha_of(base: Gaussians | None, tile: TileId = TILE) -> bytes:
    """The hash by which a report names its base; none: the vehicle had no map."""
    return b"" if base is None else content_sha(tile, base)


def change_of(
    base: Gaussians | None,
    observed: Sequence[int],
    changed: Mapping[int, State | None] | Gaussians,
    *,
    tile: TileId = TILE,
    change_class: ChangeClass = ChangeClass.MODIFIED,
    version: int = 1,
    withheld: Sequence[int] = (),
) -> TileChange:
    """One report's part about a tile; the Gaussians of the voxels `withheld` were not asked for."""
    gaussians = changed if isinstance(changed, Gaussians) else gaussians_of(changed)
    return TileChange(
        tile=tile,
        base_version=0 if base is None else version,
        base_sha=sha_of(base, tile),
        observed=np.array(sorted(observed), np.int32),
        changed=gaussians,
        change_class=_classes(gaussians, change_class, withheld),
        evidence=np.zeros((len(gaussians), 4), np.int32),
        pose_sigma_m=0.03,
        pose_sigma_rad=0.001,
    )


def _classes(gaussians: Gaussians, change_class: ChangeClass, withheld: Sequence[int]) -> np.ndarray:
    """The class for all voxels; "modified" where nothing is any more is "deleted", as vehicles say."""
    gone = ChangeClass.DELETED if change_class == ChangeClass.MODIFIED else change_class
    keeps = gaussians.exists | np.isin(gaussians.voxel_id, withheld)
    return np.where(keeps, change_class, gone).astype(np.uint8)


def report_id(number: int) -> str:
    """Ids that sort as their numbers."""
    return deterministic_report_id(1_700_000_000_000 + number, "test")


def report_of(number: int, *changes: TileChange, vehicle: str = "") -> ChangeReport:
    """A whole report with these tiles, all of one district."""
    return ChangeReport(
        report_id=report_id(number),
        vehicle=vehicle or f"car-{number}",
        sensor_model="VLP-16",
        software="test 1",
        district=changes[0].tile.district,
        first_ns=1_700_000_000_000_000_000 + number,
        last_ns=1_700_000_001_000_000_000 + number,
        tiles=changes,
    )


def tile_of_states(states: Mapping[int, State], tile: TileId = TILE, version: int = 1) -> Tile:
    """A tile with these voxels."""
    return Tile(tile, version, gaussians_of(states))
