"""Real recordings through the whole loop: one half of the scans makes the map, vehicles drive the other half.

An object inserted ray-accurately into the vehicles' scans must come back as new in the published map, one that is
inserted into the map's scans as deleted. The truth is exact: the voxels in which the sensor measured the object.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from fleet_testing import Run

from gnd.deploy.account import TileHistory, tile_histories
from gnd.fleet_sim.insert_drive import rewrite_drive
from gnd.fleet_sim.shapes import Block
from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile_id import TileId, covering_circle
from gnd.schemas.drive_mcap import load_track, read_header
from gnd.tile_store.build import build_map
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.importer import import_recording
from gnd.vehicle_agent.importers.choices import Choices
from gnd.vehicle_agent.importers.recording import NOMINAL as ANCHOR

pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Recording:
    kind: str
    folder: str
    new_at_m: tuple[float, float]  # forward and left of the middle pose
    gone_at_m: tuple[float, float]
    half_m: tuple[float, float]  # half length and width of the boxes


KITTI = Recording("kitti", "kitti00_start16", (8.0, 4.0), (0.0, 4.0), (0.8, 0.5))
# On the left lies open field: fog returns no beam from behind an object there, so nothing could show that it is gone.
RADIATE = Recording("radiate", "radiate_fog", (6.0, 4.0), (-2.0, -4.0), (1.3, 0.9))


def box_at(drive: Path, at_m: tuple[float, float], half_m: tuple[float, float]) -> Block:
    """A box 2.3 m high beside the road, in the frame of the drive's reference poses."""
    T = load_track(drive)[2].T_map_vehicle
    T_map_vehicle = T[len(T) // 2]
    x_m, y_m, z_m, _ = T_map_vehicle @ np.array([*at_m, 0.0, 1.0])
    yaw_rad = float(np.arctan2(T_map_vehicle[1, 0], T_map_vehicle[0, 0]))
    return Block(float(x_m), float(y_m), *half_m, float(z_m) - 0.3, float(z_m) + 2.0, yaw_rad)


def measured_voxels(drive: Path, points_m: np.ndarray) -> dict[TileId, np.ndarray]:
    """Ids of the voxels with at least 20 sub-cells of these points (frame of the reference poses)."""
    frame = read_header(drive).anchor
    lat, lon, _ = frame.geodetic_from_enu(points_m[:1])
    accumulator = VoxelAccumulator(GridFrame.around(frame, covering_circle(float(lat[0]), float(lon[0]), 60.0)))
    accumulator.add(points_m)
    return {tile: gaussians.voxel_id for tile, gaussians in accumulator.finish().items()}


def shares(
    histories: dict[TileId, TileHistory], new: dict[TileId, np.ndarray], gone: dict[TileId, np.ndarray]
) -> tuple[float, float, int, int]:
    """How much of the new object is in the map, how much of the vanished one is not, and of how many voxels each."""
    there = [np.isin(v, histories[t].after.voxel_id)[~np.isin(v, histories[t].before.voxel_id)] for t, v in new.items()]
    away = [~np.isin(v, histories[t].after.voxel_id)[np.isin(v, histories[t].before.voxel_id)] for t, v in gone.items()]
    found, lost = np.concatenate(there), np.concatenate(away)
    return float(found.mean()), float(lost.mean()), len(found), len(lost)


@pytest.mark.parametrize("recording", [KITTI, RADIATE], ids=lambda recording: recording.kind)
def test_inserted_objects_come_back_as_new_and_deleted(recording: Recording, shared_data: Path, tmp_path: Path) -> None:
    whole = tmp_path / "whole.mcap"
    folder, choices = shared_data / recording.folder, Choices(stand_ins=True)
    anchor = ANCHOR if recording.kind == "kitti" else None  # RADIATE has its own place
    import_recording(recording.kind, folder, whole, anchor=anchor, choices=choices)
    new = box_at(whole, recording.new_at_m, recording.half_m)
    gone = box_at(whole, recording.gone_at_m, recording.half_m)
    mapped = rewrite_drive(whole, tmp_path / "mapped.mcap", [gone], slice(0, None, 2))
    driven = rewrite_drive(whole, tmp_path / "driven.mcap", [new], slice(1, None, 2))
    with SqliteStore(tmp_path / "base.sqlite") as store:
        build_map([tmp_path / "mapped.mcap"], store)

    run = Run(
        tmp_path / "run", "--drives", str(tmp_path / "driven.mcap"), "--map", str(tmp_path / "base.sqlite"),
        "--agents", "2", "--link", "none",
    )  # fmt: skip
    summary = run.finish()

    assert summary["reports_lost"] == 0
    assert summary["updates_received"] >= summary["tiles_published"] > 0
    with SqliteStore(tmp_path / "run" / "store.sqlite") as store:
        histories = {history.tile.tile: history for history in tile_histories(store)}
    found, lost, n_new, n_gone = shares(
        histories, measured_voxels(whole, driven.on_object_m), measured_voxels(whole, mapped.on_object_m)
    )
    print(f"{recording.kind}: {found:.0%} of {n_new} new, {lost:.0%} of {n_gone} deleted; {summary}")
    assert n_new >= 4
    assert n_gone >= 4
    assert found >= 0.6
    assert lost >= 0.6
