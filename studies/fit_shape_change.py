"""Fits the trees of `gnd.vehicle_agent.detect.shape_change` on simulated worlds: `python -m studies.fit_shape_change`.

For every vehicle of a mixed fleet (six sensors, poses off by 4 cm and 0.08 degrees) all voxels that hold a measured
Gaussian where the map has one; the label is the truth's, modified or normal. Voxels that are scored weigh three times
the marginal ones. The seeds are those on which detection is tuned; no result is reported on them.
"""

from argparse import ArgumentParser
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import HistGradientBoostingClassifier

from gnd.fleet_sim.drives import DriveConfig, DriveSimulation
from gnd.fleet_sim.evaluate import voxel_rows
from gnd.fleet_sim.street import StreetOptions, street
from gnd.fleet_sim.truth import Truth, make_truth
from gnd.fleet_sim.world import World
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.grid import GridFrame
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.detect.evidence import TileEvidence
from gnd.vehicle_agent.detect.parameters import MIN_CELLS
from gnd.vehicle_agent.detect.shape_change import MONOTONE, Forest, shape_features
from studies.frame.scans import local_map_of
from studies.simulation.options import PoseSource, RunOptions, fleet_configs
from studies.simulation.poses import FromReference

SEEDS = (101, 102, 103)
SCORED_WEIGHT = 3.0
TREES = 60
_TARGET = Path(__file__).parents[1] / "vehicle_agent" / "detect" / "shape_change.json"


class Examples(NamedTuple):
    """Features (N, 10), whether the voxel is modified (N,), whether it is scored (N,)."""

    features: F64
    modified: NDArray[np.bool_]
    scored: NDArray[np.bool_]


def examples_of_world(seed: int, vehicles: int) -> Examples:
    """Return the examples of all vehicles of one world of 200 m."""
    world = street(seed, StreetOptions(200.0))
    truth = make_truth(world)
    options = RunOptions(seeds=(seed,), vehicles=(vehicles,), traffic=False)
    found = [examples_of_drive(world, truth, config) for config in fleet_configs(options, seed)]
    return joined(found)


def examples_of_drive(world: World, truth: Truth, config: DriveConfig) -> Examples:
    """Return the examples of one drive on the map of the state before."""
    simulation = DriveSimulation(world, config)
    local_map = local_map_of(GridFrame.around(world.frame, sorted(truth.before)), truth.before)
    detector = ChangeDetector(local_map)
    poses = FromReference(simulation.header(), local_map, PoseSource(), config.seed)
    for item in simulation.items():
        for scan in poses.push(item):
            detector.add_scan(scan.points_map_m, scan.origins_map_m)
    return joined([examples_of_tile(truth, found) for found in detector.finish(local_map.tiles).values()])


def examples_of_tile(truth: Truth, e: TileEvidence) -> Examples:
    """Return the examples of a tile: voxels that truly hold a Gaussian before and after, and do so as measured."""
    at = voxel_rows(truth, e.base.tile_id, e.voxel_id)
    true_class = np.where(at >= 0, truth.change_class[at], ChangeClass.EMPTY)
    both = np.isin(true_class, (ChangeClass.NORMAL, ChangeClass.MODIFIED)) & e.in_map
    rows = np.flatnonzero(both & (e.measured.cells >= MIN_CELLS))
    was = e.base.gaussians.take(e.map_row[rows])
    features = shape_features(was, e.measured.take(rows), e.n_bi[rows], e.n_bo[rows], e.n_pi[rows])
    return Examples(features, true_class[rows] == ChangeClass.MODIFIED, truth.mask("scored")[at[rows]])


def joined(parts: list[Examples]) -> Examples:
    """Return all examples together."""
    return Examples(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def fit(examples: Examples) -> HistGradientBoostingClassifier:
    """Fit boosted trees of at most eight leaves; the same examples give the same trees."""
    model = HistGradientBoostingClassifier(
        max_iter=TREES,
        learning_rate=0.15,
        max_leaf_nodes=8,
        min_samples_leaf=40,
        l2_regularization=1.0,
        monotonic_cst=list(MONOTONE),
        early_stopping=False,
        random_state=0,
    )
    return model.fit(examples.features, examples.modified, np.where(examples.scored, SCORED_WEIGHT, 1.0))


def forest_of(model: HistGradientBoostingClassifier) -> Forest:
    """Return a fitted model's trees as the vehicle evaluates them."""
    trees = [predictors[0].nodes for predictors in model._predictors]
    sizes = np.cumsum([0, *map(len, trees)])
    columns: dict[str, list[Any]] = {"feature": [], "threshold": [], "left": [], "right": []}
    for nodes, start in zip(trees, sizes[:-1].tolist(), strict=True):
        leaf = nodes["is_leaf"].astype(bool)
        columns["feature"].append(np.where(leaf, -1, nodes["feature_idx"].astype(np.int32)))
        columns["threshold"].append(np.where(leaf, nodes["value"], nodes["num_threshold"]))
        columns["left"].append(np.where(leaf, 0, start + nodes["left"].astype(np.int64)))
        columns["right"].append(np.where(leaf, 0, start + nodes["right"].astype(np.int64)))
    joint = {name: np.concatenate(parts) for name, parts in columns.items()}
    ints = {name: joint[name].astype(np.int32) for name in ("feature", "left", "right")}
    baseline = float(np.ravel(model._baseline_prediction)[0])
    return Forest(baseline, sizes[:-1].astype(np.int32), threshold=joint["threshold"].astype(np.float64), **ints)


def main() -> None:
    """Fit on all seeds and write the file."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default=",".join(map(str, SEEDS)), help="tuning worlds")
    parser.add_argument("--vehicles", type=int, default=12)
    parser.add_argument("--out", type=Path, default=_TARGET)
    options = parser.parse_args()
    seeds = [int(text) for text in options.seeds.split(",")]
    with ProcessPoolExecutor(2) as pool:
        found = list(pool.map(examples_of_world, seeds, [options.vehicles] * len(seeds)))
    options.out.write_text(forest_of(fit(joined(found))).to_json(), encoding="utf-8")
    print(f"{options.out.name}: {TREES} trees")


if __name__ == "__main__":
    main()
