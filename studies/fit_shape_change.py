"""Fits what decides "modified": `python -m studies.fit_shape_change --recordings FOLDER`.

Collects voxels of worlds and recordings (`studies.modified_study.sources`), fits the model of the vehicle
(`gnd.vehicle_agent.detect.shape_change`) and that of the point-cloud baseline (`studies.pcd.shapes`), and writes both
files. What was collected is kept in `--rows`: a second start goes on. `gnd reproduce modified` tests them elsewhere.
"""

from argparse import ArgumentParser
from pathlib import Path

from rich.console import Console

from gnd.deploy.live import progress_bars
from gnd.vehicle_agent.detect.shape_change import FEATURES, ShapeModel
from studies.frame.command import Bench
from studies.frame.folder import StudyFolder
from studies.modified_study.rows import Method
from studies.modified_study.rules import fitted_model
from studies.modified_study.study import training_rows

_ROOT = Path(__file__).parents[1]
TARGETS: dict[Method, Path] = {
    "gnd": _ROOT / "vehicle_agent" / "detect" / "shape_change.json",
    "cloud": _ROOT / "studies" / "pcd" / "shape_change.json",
}


def fit_and_write(bench: Bench, method: Method, recordings: Path, out: Path) -> ShapeModel:
    """Fit the model of a method and write it."""
    model = fitted_model(training_rows(bench, method, recordings))
    out.write_text(model.to_json(), encoding="utf-8")
    return model


def main() -> None:
    """Fit both and write the files."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--recordings", type=Path, required=True, help="folder of kitti00_start16 and radiate_fog")
    parser.add_argument("--rows", type=Path, default=Path("runs/shape-rows"), help="keeps what was collected")
    parser.add_argument("--jobs", type=int, default=2, help="worker processes")
    options = parser.parse_args()
    folder = StudyFolder.create(options.rows, "shape-rows", marked=False)
    with progress_bars(Console(stderr=True)) as progress:
        bench = Bench(folder, options.jobs, progress)
        for method, out in TARGETS.items():
            model, where = fit_and_write(bench, method, options.recordings, out), out.relative_to(_ROOT)
            plain = model.plain
            sign = "below" if plain.below else "above"
            print(f"{where}: {len(model.forest.root)} trees, log-odds above {model.limit:g}, similarity below"
                  f" {model.alike:g};"
                  f" outside their range {FEATURES[plain.feature]} {sign} {plain.threshold:.3f}")  # fmt: skip


if __name__ == "__main__":
    main()
