"""Measure `gnd map align` with HD maps: python tests/map_align/measure_posts.py FOLDER SEED...

First posts that are drawn (100 seeds from 1000): how many of what is right fit, and of what is wrong. Then each of
these simulated streets: its lamps and signs, moved and changed, on the map of a drive through it.
"""

import json
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from click.testing import CliRunner
from test_align_hd_map import furniture, write_osm
from test_align_posts import aligned, lidar_of, placed, street

from gnd.deploy.map_cli import map_group
from gnd.fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.street import StreetOptions
from gnd.fleet_sim.street import street as simulated_street
from gnd.gnd_map.arrays import F64
from gnd.schemas.drive_mcap import read_header
from gnd.tile_store.build import build_map
from gnd.tile_store.sqlite_store import SqliteStore

LENGTH_M = 130.0


def drawn(seeds: range) -> None:
    """Posts of streets that are drawn, 14 to 39 of them, with 20 or 60 others in the LiDAR map."""
    fits, errors_m = Counter[str](), list[float]()
    for seed in seeds:
        posts = street(seed, n=int(np.random.default_rng(seed).integers(14, 40)))
        rng = np.random.default_rng([seed, 2])
        moved = placed(posts, float(rng.uniform(-3.5, 3.5)), tuple(rng.uniform(-6, 6, 2)))
        wrong = {"another street": street(seed + 5000), "mirrored": posts * [1, -1], "mirrored x": posts * [-1, 1],
                 "feet": posts / 0.3048, "0.6 % larger": posts * 1.006, "2 % larger": posts * 1.02}  # fmt: skip
        for others in (20, 60):
            lidar = lidar_of(posts, seed, others=others)
            found = aligned(lidar, moved)
            fits[f"right, {others} others"] += found.fits
            if found.fits:
                back = moved @ found.T_lidar_vector[:2, :2].T + found.T_lidar_vector[:2, 3]
                errors_m.append(float(np.linalg.norm((back - posts).mean(axis=0))))
            for name, vector in wrong.items():
                fits[f"{name}, {others} others"] += aligned(lidar, vector).fits
    print(f"of {len(seeds)} each fit: {dict(fits)}")
    print(f"error of what is right: mean {np.mean(errors_m):.3f} m, largest {np.max(errors_m):.3f} m")


def changes(seed: int) -> Iterator[tuple[str, F64, F64]]:
    """Name, (2, 2) and shift (2,) of what is done to the HD map about its middle."""
    rng, one = np.random.default_rng(seed), np.eye(2)
    yield "as it is", one, np.zeros(2)
    for k in range(3):
        c, s = np.cos(turn := np.radians(rng.uniform(-3, 3))), np.sin(turn)
        yield f"moved {k}", np.array([[c, s], [-s, c]]), rng.uniform(-6, 6, 2)
    for name, A in (("mirrored", np.diag([1.0, -1.0])), ("mirrored x", np.diag([-1.0, 1.0])), ("feet", one / 0.3048),
                    ("0.6 % larger", 1.006 * one), ("0.3 % larger", 1.003 * one)):  # fmt: skip
        yield name, A, np.zeros(2)


def measured(seed: int, other: int, folder: Path) -> None:
    """One street; `other`: another one, whose lamps and signs are taken for this one's."""
    world, drive, store_path = (
        simulated_street(seed, StreetOptions(length_m=LENGTH_M)),
        folder / f"{seed}.mcap",
        folder / f"{seed}.sqlite",
    )
    if not store_path.exists():
        simulate_drive(world, DriveConfig("car", "VLP-16", "before", seed=1, cruise_mps=12.0, errors=PERFECT), drive)
        with SqliteStore(store_path) as store:
            build_map([drive], store)
    frame, (places, types) = read_header(drive).anchor, furniture(world)
    middle = places[:, :2].mean(axis=0)
    rows = [(name, (places[:, :2] - middle) @ A + middle + shift, types, places[:, :2])
            for name, A, shift in changes(seed)]  # fmt: skip
    elsewhere, kinds = furniture(simulated_street(other, StreetOptions(length_m=LENGTH_M)))
    rows.append((f"street {other}", elsewhere[:, :2], kinds, elsewhere[:, :2]))
    for name, wrong, of_type, right in rows:
        hd_map = write_osm(folder / "hd.osm", frame, np.c_[wrong, np.zeros(len(wrong))], of_type)
        ran = CliRunner().invoke(map_group, ["align", str(store_path), str(hd_map), "--json"])
        values = json.loads(ran.stdout)
        told = f"{values['posts']['matched']} of {values['posts']['seen']}, second {values['second_best']:.2f}"
        if values["fits"]:
            T_tile = np.array(values["T_a_b"])
            error_m = error_of(T_tile, values["frame"], frame, wrong, right)
            told += f", error {error_m:.3f} m, sigma {values['sigma_m']:.3f} m each way"
        print(f"street {seed}, {name}: {'fits' if values['fits'] else 'refused'}, {told}", *values["reasons"], sep="; ")


def error_of(T: F64, place: dict[str, float], frame, wrong: F64, right: F64) -> float:
    """Distance [m] of the middle of the posts, once moved, from where they stand."""
    from gnd.gnd_map.geodesy import LocalFrame
    from gnd.gnd_map.se3 import T_inverse, transform

    common = LocalFrame(place["lat_rad"], place["lon_rad"], 0.0)
    T_common = common.T_self_other(frame)
    back = transform(T_inverse(T_common) @ T @ T_common, np.c_[wrong, np.zeros(len(wrong))])
    return float(np.linalg.norm((back[:, :2] - right).mean(axis=0)))


if __name__ == "__main__":
    folder, seeds = Path(sys.argv[1]), [int(one) for one in sys.argv[2:]]
    folder.mkdir(exist_ok=True, parents=True)
    drawn(range(1000, 1100))
    for seed, other in zip(seeds, [*seeds[1:], seeds[0]], strict=True):
        measured(seed, other, folder)
