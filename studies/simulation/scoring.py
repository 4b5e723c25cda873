"""Maps against the truth: what was stale, what single drives make of it, what the fleet makes of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.merge import MergeParameters
from gnd.fleet_sim.evaluate import Evaluation, Score, evaluate_maps
from gnd.fleet_sim.truth import LEVELS, Level, read_truth
from studies.simulation.cloud import map_of_one, merged_map
from studies.simulation.options import Upload
from studies.simulation.result import VehicleResult, read_result
from studies.simulation.uploads import arrived
from studies.simulation.worlds import WorldFiles, read_world_base

STALE = "stale"


@dataclass(frozen=True, slots=True, eq=False)
class Scored:
    """One map compared with the truth: confusion matrices int64 (5, 5) by level, rows true, columns predicted."""

    confusion: dict[Level, NDArray[np.int64]]

    @classmethod
    def of(cls, evaluation: Evaluation) -> "Scored":
        """Keep the matrices of an evaluation."""
        return cls({level: evaluation.scores[level].confusion for level in LEVELS})

    def score(self, level: Level) -> Score:
        """Return the score of a level."""
        return Score(level, self.confusion[level])

    def f1(self, level: Level = "scored") -> float:
        """Return the macro F1 of a level, percent."""
        return self.score(level).macro_f1


@dataclass(frozen=True, slots=True)
class VehicleFile:
    """A vehicle's result in the cache."""

    path: Path
    key: str

    def read(self) -> VehicleResult:
        """Read it."""
        return read_result(self.path, self.key)


def score_single(files: WorldFiles, vehicles: Sequence[VehicleFile]) -> dict[str, Scored]:
    """Return the stale map's score and that of each vehicle alone, by name."""
    truth, base = read_truth(files.truth), read_world_base(files)
    found = {STALE: Scored.of(evaluate_maps(truth, base.tiles, base.tiles))}
    for vehicle in vehicles:
        result = vehicle.read()
        found[result.vehicle] = Scored.of(evaluate_maps(truth, base.tiles, map_of_one(base, result.reports)))
    return found


def score_fleet(
    files: WorldFiles,
    vehicles: Sequence[VehicleFile],
    numbers: Sequence[int],
    merge: MergeParameters,
    upload: Upload = "full",
) -> dict[int, Scored]:
    """Return the score of the merged map of the first n vehicles, for each n asked for."""
    truth, base = read_truth(files.truth), read_world_base(files)
    held = arrived(base, [vehicle.read() for vehicle in vehicles[: max(numbers)]], merge, upload)
    found = {}
    for n in numbers:
        bodies = [body for one in held[:n] for body in one.bodies]
        found[n] = Scored.of(evaluate_maps(truth, base.tiles, merged_map(base, bodies, merge)))
    return found


def sent_bytes(
    files: WorldFiles, vehicles: Sequence[VehicleFile], merge: MergeParameters, upload: Upload
) -> tuple[list[int], list[int]]:
    """Return what each vehicle sends: one after the other to the same cloud, and each alone to a cloud of its own."""
    base, results = read_world_base(files), [vehicle.read() for vehicle in vehicles]
    together = [one.sent_bytes for one in arrived(base, results, merge, upload)]
    return together, [arrived(base, [result], merge, upload)[0].sent_bytes for result in results]


def score_pcd(files: WorldFiles, vehicles: Sequence[VehicleFile], numbers: Sequence[int]) -> dict[str | int, Scored]:
    """Return the baseline's scores: of each vehicle alone by name, of the first n vehicles by number."""
    from studies.simulation.baseline import Clouds, read_cloud

    clouds = Clouds(read_truth(files.truth), read_cloud(files.cloud))
    results = [vehicle.read() for vehicle in vehicles]
    found: dict[str | int, Scored] = {r.vehicle: Scored.of(clouds.score([r.pcd])) for r in results}
    return found | {n: Scored.of(clouds.score([r.pcd for r in results[:n]])) for n in numbers}
