"""Which claims of each vehicle of a kept fleet are wrong by the truth, and of what kind.

`python -m studies.trust_study.claims WORLD…` reads the folders of worlds that `gnd reproduce trust --out FOLDER` keeps.
"""

from collections import Counter
from pathlib import Path
from typing import Final

import click
import numpy as np

from gnd.fleet_sim.truth import CHANGES, Truth, read_truth
from gnd.gnd_map.arrays import F64, are_in
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.vehicle_agent.detect.classify import INSIDE_SHARE
from gnd.vehicle_agent.detect.permeable import OPACITY_OF_VOLUME, least_opacity
from studies.frame.tables import sheet
from studies.simulation.base_map import read_base
from studies.simulation.result import read_result

COLUMNS: Final = (
    "claims", "wrong", "new, wrong", "modified, wrong", "of it inside", "inside, right", "deleted, wrong",
    "of it no plane", "no plane, right",
)  # fmt: skip
"""Wrong: the truth calls the voxel unchanged, or does not hold it. Inside: at most 5 % of the points lie outside the
map's Gaussian. No plane: the map's Gaussian is none.
"""


@click.command(help=__doc__)
@click.argument("worlds", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
def main(worlds: tuple[Path, ...]) -> None:
    """Print one line a vehicle result that a world keeps."""
    for world in worlds:
        table = sheet(world.name, "result", *COLUMNS)
        truth, base = read_truth(world / "truth.npz"), read_base(world / "base-surveyed.npz").tiles
        for path in sorted((world / "vehicles").glob("*.npz")):
            found = Counter[str]()
            for body in read_result(path).reports:
                for change in ChangeReport.decode(body).tiles:
                    found += counted(change, truth, base.get(change.tile, Gaussians.empty()))
            table.add(path.stem, *(found[name] for name in COLUMNS))
        click.echo(table.markdown())


def counted(change: TileChange, truth: Truth, was: Gaussians) -> Counter[str]:
    """How many claims about a tile are of which of `COLUMNS`."""
    ids, said = change.changed.voxel_id, change.change_class
    of_tile = truth.morton == change.tile.morton
    changed = truth.voxel_id[of_tile & np.isin(truth.change_class, CHANGES)]
    right = are_in(ids, changed)
    inside, no_plane = _share_outside(change) <= INSIDE_SHARE, np.zeros(len(ids), np.bool_)
    known = are_in(ids, was.voxel_id)
    no_plane[known] = least_opacity(was.select(ids[known])) == OPACITY_OF_VOLUME
    new, modified, deleted = (said == one for one in (ChangeClass.NEW, ChangeClass.MODIFIED, ChangeClass.DELETED))
    of = (
        np.ones(len(ids), np.bool_), ~right, new & ~right, modified & ~right, modified & inside & ~right,
        modified & inside & right, deleted & ~right, deleted & no_plane & ~right, deleted & no_plane & right,
    )  # fmt: skip
    return Counter({name: int(which.sum()) for name, which in zip(COLUMNS, of, strict=True)})


def _share_outside(change: TileChange) -> F64:
    """(N,) of the points that ended in a voxel, those outside the map's Gaussian."""
    n_bi, n_bo = change.evidence[:, 0], change.evidence[:, 1]
    return np.asarray(n_bo / np.maximum(n_bi + n_bo, 1), np.float64)


if __name__ == "__main__":
    main()
