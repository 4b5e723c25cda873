"""A finished run of `gnd fleet` in small: a street of three tiles, and what two vehicles kept in their outboxes."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from gnd.deploy.run_folder import RunFolder, create_run_folder
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.codec import LATTICES, REPORT, snap
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.gnd_map.track import STEPS, Track, TrackPiece, TrackView
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.keys import change_key
from gnd.schemas.report_id import deterministic_report_id
from gnd.schemas.report_states import ReportState
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.link.outbox import Outbox
from gnd.vehicle_agent.report.packing import pack

FIRST = TileId(497353963154)
T0_NS = 1_700_000_000_000_000_000
LENGTH_M = 100.0
SPEED_M_S = 10.0


def street_tiles() -> list[Tile]:
    """Ground, and a wall along the northern side."""
    tiles = sorted([FIRST, *(TileId.from_indices(FIRST.lon_index + k, FIRST.lat_index) for k in (1, 2))])
    return [Tile(tile_id, 1, _ground(tile_id)) for tile_id in tiles if tile_id.district == FIRST.district]


def _ground(tile_id: TileId) -> Gaussians:
    grid = VoxelGrid.of(tile_id)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(grid.nx), np.arange(grid.ny)))
    wall_x, wall_z = (axis.ravel() for axis in np.meshgrid(np.arange(grid.nx), np.arange(1, 5)))
    ids = [grid.voxel_id(x, y, 0), grid.voxel_id(wall_x, np.full_like(wall_x, grid.ny - 3), wall_z)]
    return _gaussians(np.concatenate(ids))


def _gaussians(voxel_id: np.ndarray, mean_m: float = 0.0) -> Gaussians:
    voxel_id = np.sort(voxel_id).astype(np.int32)
    n = len(voxel_id)
    cov = np.tile(np.array([0.08, 0, 0, 0.08, 0, 0.001], np.float32), (n, 1))
    mean = np.full((n, 3), mean_m, np.float32)
    counts = np.full(n, 200, np.int32), np.full(n, 60, np.int32)
    return snap(Gaussians(voxel_id, *counts, mean, cov), LATTICES["standard"])


def change_of(tile: Tile) -> TileChange:
    """A box that is new, ground that is another, and a piece of wall that has gone."""
    grid = VoxelGrid.of(tile.tile_id)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(10, 16), np.arange(10, 14)))
    new = grid.voxel_id(x, y, 1)
    modified = grid.voxel_id(x, y, 0)
    gone = grid.voxel_id(np.arange(20, 26), np.full(6, grid.ny - 3), 2)
    changed = [snap(_gaussians(new), REPORT), snap(_gaussians(modified, 0.2), REPORT)]
    nothing = _gaussians(gone)
    zeros = np.zeros(len(gone), np.int32)
    nothing = Gaussians(
        nothing.voxel_id,
        zeros,
        zeros.copy(),
        np.zeros((len(gone), 3), np.float32),
        np.zeros((len(gone), 6), np.float32),
    )
    parts = [*changed, nothing]
    kinds = [ChangeClass.NEW, ChangeClass.MODIFIED, ChangeClass.DELETED]
    ids = np.concatenate([part.voxel_id for part in parts])
    order = np.argsort(ids)
    columns = ("voxel_id", "count", "cells", "mean_m", "cov_m2")
    merged = Gaussians(*(np.concatenate([getattr(part, name) for part in parts])[order] for name in columns))
    classes = np.concatenate([np.full(len(p), kind, np.uint8) for p, kind in zip(parts, kinds, strict=True)])[order]
    return TileChange(
        tile=tile.tile_id,
        base_version=1,
        base_sha=tile.sha,
        observed=np.union1d(tile.gaussians.voxel_id, ids).astype(np.int32),
        changed=merged,
        change_class=classes,
        evidence=np.full((len(ids), 4), 9, np.int32),
        pose_sigma_m=0.02,
        pose_sigma_rad=0.001,
    )


def track_along(tile: Tile) -> Track:
    """Through the middle of a tile, 2 m over the ellipsoid."""
    first = TileId(tile.tile_id.district.first_morton)
    x = STEPS * (tile.tile_id.lon_index - first.lon_index)
    y = STEPS * (tile.tile_id.lat_index - first.lat_index) + STEPS // 2
    vertices = np.array([[x, y, 4], [x + STEPS, y, 4]], np.int32)
    return Track(tile.tile_id.district, TrackView((-60, -48, -36, -24, -12, -6, 0, 6, 20)), (TrackPiece(vertices, 40),))


def whole_report(vehicle: str, number: int, tile: Tile) -> ChangeReport:
    """What a vehicle says of one tile."""
    last_ns = T0_NS + int((number + 1) * 30.0 / SPEED_M_S * 1e9)
    return ChangeReport(
        report_id=deterministic_report_id(T0_NS // 1_000_000 + number, vehicle),
        vehicle=vehicle,
        sensor_model="VLP-16",
        software="test",
        district=tile.tile_id.district,
        first_ns=T0_NS,
        last_ns=last_ns,
        tiles=(change_of(tile),),
    )


def make_run(root: Path, vehicles: int = 2) -> Path:
    """Write the folder of a run as its vehicles and its cloud would have."""
    folder = create_run_folder(root)
    folder.write_mark({})
    tiles = street_tiles()
    with SqliteStore(folder.store) as store:
        store.put_tiles(tiles)
    for number in range(vehicles):
        put_vehicle(folder, f"vehicle-{number:02d}", tiles)
    return root


def put_vehicle(folder: RunFolder, vehicle: str, tiles: list[Tile]) -> None:
    """Its outbox, everything released, and its way."""
    home = folder.agents / vehicle
    home.mkdir(parents=True)
    outbox = Outbox(home / "outbox.sqlite")
    for number, tile in enumerate(tiles):
        report = whole_report(vehicle, number, tile)
        packed = pack(report, {tile.sha: tile.gaussians}, track_along(tile)).encode()
        outbox.put(report.report_id, change_key("ndt", report.district), report.encode(), packed, [tile])
        outbox.answered(report.report_id, "stored", is_short=True)
        outbox.told(ReportState(report.report_id, "released"), 0)
    outbox.close()
    put_way(home / "way.jsonl")


def put_way(path: Path) -> None:
    """A milestone every 5 m."""
    steps = np.arange(0.0, LENGTH_M + 1.0, 5.0)
    lines = [{"t_ns": T0_NS + int(m / SPEED_M_S * 1e9), "odometer_m": float(m)} for m in steps]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")


def against(report: ChangeReport, sha: bytes) -> ChangeReport:
    """The same, made against another content."""
    return replace(report, tiles=tuple(replace(change, base_sha=sha) for change in report.tiles))
