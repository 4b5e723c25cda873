"""Measure `gnd map align` on simulated streets: python tests/map_align/measure_alignment.py FOLDER SEED...

Of each street two drives (before and after its works, up and down it). The second is moved by known amounts, a map is
built of it anew, and the two maps are aligned. Then what must be refused: each row says what was done to B.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gnd.fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.street import StreetOptions, street
from gnd.fleet_sim.trajectory import Direction
from gnd.fleet_sim.world import State
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.se3 import T_inverse, exp_so3
from gnd.gnd_map.tile import Tile
from gnd.tile_store.build import build_map
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.map_align.align import MapAlignment, align_clouds, difference
from gnd.vehicle_agent.map_align.candidates import Reach, about
from gnd.vehicle_agent.map_align.cloud import GaussianCloud, cloud_of_tiles
from gnd.vehicle_agent.map_align.move import moved_drive, moved_tiles
from gnd.vehicle_agent.map_align.sources import Side

REACH = Reach(10.0, 5.0, 10.0)
MOVES = 3


def tiles_of(drive: Path) -> tuple[Tile, ...]:
    """The tiles of a drive, each point in its voxel."""
    store_path = drive.with_suffix(".sqlite")
    store_path.unlink(missing_ok=True)
    with SqliteStore(store_path) as store:
        build_map([drive], store)
        stored = [store.get("ndt", entry.tile) for entry in store.heads("ndt")]
        return tuple(tile for one in stored if one is not None and isinstance(tile := one.decode(), Tile))


def drives_of(seed: int, folder: Path, length_m: float = 130.0) -> list[Path]:
    """Two drives of a street, written unless they are there."""
    world, paths = street(seed, StreetOptions(length_m=length_m)), list[Path]()
    passes: tuple[tuple[State, Direction], ...] = (("before", 1), ("after", -1))
    for k, (state, direction) in enumerate(passes):
        paths.append(folder / f"{seed}-{k}.mcap")
        if not paths[-1].exists():
            config = DriveConfig(
                "car", "VLP-16", state, seed=seed + k, direction=direction, cruise_mps=12.0, errors=PERFECT
            )
            simulate_drive(world, config, paths[-1])
    return paths


def random_motion(rng: np.random.Generator, pivot_m: F64) -> F64:
    """(4, 4) up to 6 m each way, 3 degrees of heading, 3 m of height, 0.3 degrees of tilt."""
    T = about(pivot_m, float(np.radians(rng.uniform(-3, 3))))
    tilt = np.eye(4)
    tilt[:3, :3] = exp_so3(np.radians([*rng.uniform(-0.3, 0.3, 2), 0.0]))
    tilt[:3, 3] = pivot_m - tilt[:3, :3] @ pivot_m + [*rng.uniform(-6, 6, 2), rng.uniform(-3, 3)]
    return np.asarray(tilt @ T)


def spoiled(b: GaussianCloud) -> Iterator[tuple[str, GaussianCloud]]:
    """B in ways that must be refused, with names."""
    p, middle = b.mean_m, b.mean_m.mean(axis=0)
    along = np.linalg.eigh(np.cov(p[:, :2].T))[1][:, 1]
    across = np.array([-along[1], along[0], 0.0])
    way = (p[:, :2] - middle[:2]) @ along
    for bend_m in (0.6, 1.5):
        yield (
            f"bent by {bend_m} m at 65 m",
            GaussianCloud.of(p + bend_m * (way / 65.0)[:, None] ** 2 * across, b.spread_m2),
        )
    for scale in (0.3048, 1.003, 1.01, 3.2808):
        yield f"scaled by {scale}", GaussianCloud.of((p - middle) * scale + middle, b.spread_m2 * scale**2)
    for name, axis in (("across", across), ("along", np.append(along, 0.0))):
        F = np.eye(3) - 2.0 * np.outer(axis, axis)
        yield f"mirrored {name}", GaussianCloud.of((p - middle) @ F + middle, F @ b.spread_m2 @ F)
    away = np.eye(4)
    away[0, 3] = 300.0
    yield "300 m away", b.moved(away)


def line(name: str, found: MapAlignment, T_true: F64 | None = None) -> str:
    """One row of the account."""
    error = ""
    if T_true is not None:
        m, rad = difference(found.T_a_b, T_true, found.pivot_m)
        worst = float(np.sqrt(np.diag(found.covariance)[3:]).max())
        error = f" error {100 * m:.1f} cm {np.degrees(rad):.3f} deg, sigma {100 * worst:.1f} cm"
    why = "fits" if found.fits else "refused: " + "; ".join(one.split(":")[0] for one in found.reasons)
    return (
        f"{name:32s}{error} share {found.score.share:.2f}, second {found.second:.2f}, bend {100 * found.bend_m:.0f} cm"
        f": {why}"
    )


def tell(text: str) -> None:
    """To the terminal, at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def measure(seed: int, folder: Path) -> None:
    """All of one street."""
    first, second = drives_of(seed, folder)
    other = drives_of(seed + 1, folder)[1]
    tiles = tiles_of(first)
    frame = LocalFrame.of_tile(tiles[len(tiles) // 2].tile_id)
    a, b = cloud_of_tiles(tiles, frame), cloud_of_tiles(tiles_of(second), frame)
    tell(line(f"{seed} as driven", align_clouds(a, b, REACH), np.eye(4)))
    rng = np.random.default_rng(seed)
    for k in range(MOVES):
        T = random_motion(rng, b.mean_m.mean(axis=0))
        path = folder / f"{seed}-moved-{k}.mcap"
        moved_drive(second, path, frame, T, "moved by the measurement")
        moved = tiles_of(path)
        tell(line(f"{seed} moved, built anew", align_clouds(a, cloud_of_tiles(moved, frame), REACH), T_inverse(T)))
        back = moved_tiles(Side(path, "map", moved, None), frame, T_inverse(T))
        tell(line(f"{seed} moved back by --out", align_clouds(a, cloud_of_tiles(back, frame), REACH), np.eye(4)))
        path.unlink()
    for name, cloud in spoiled(b):
        tell(line(f"{seed} {name}", align_clouds(a, cloud, REACH)))
    elsewhere = cloud_of_tiles(tiles_of(other), frame)
    tell(line(f"{seed} another street", align_clouds(a, elsewhere, REACH)))


if __name__ == "__main__":
    for one in sys.argv[2:]:
        measure(int(one), Path(sys.argv[1]))
