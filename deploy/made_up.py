"""A run whose vehicles meet made-up boxes in their own recordings, and whether the map has them afterwards."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from gnd.deploy.account import TileHistory
from gnd.deploy.errors import DeployError
from gnd.fleet_sim.ellipsoids import ellipsoids_of_maps
from gnd.fleet_sim.made_up import MadeUpBoxes, Voxels, bare_places, together, write_with_boxes
from gnd.gnd_map.classes import ChangeClass

IN_MAP_SHARE: Final = 0.5
"""A box is in the map when it has more than this share of the voxels that the LiDAR measured on it."""
AROUND_M: Final = 2.5
"""A change so near the middle of a box is due to it: its shadow on the ground, the edges of its voxels."""


@dataclass(frozen=True, slots=True)
class MadeUp:
    """The boxes of a run.

    Attributes:
        boxes: where they stand.
        voxels: of each box, those that the drives measured on it.
        asked: how many boxes were asked for; there may be fewer bare places.
    """

    boxes: MadeUpBoxes
    voxels: tuple[Voxels, ...]
    asked: int


def with_made_up_boxes(drives: Sequence[Path], n: int, folder: Path) -> tuple[tuple[Path, ...], MadeUp]:
    """The drives as copies in `folder` with n boxes beside the way of the first one, and what they measure of them.

    Raises:
        DeployError: there is no bare ground beside the way.
        DriveError: a drive cannot be read or written.
        SimError: the first drive has no reference poses, or is too short.
    """
    boxes = bare_places(drives[0], n)
    if not boxes.blocks:
        raise DeployError(f"{drives[0]}: no bare ground beside the way: nowhere to put a made-up box")
    folder.mkdir(parents=True, exist_ok=True)
    copies = {drive: folder / f"{number:02d}-{drive.name}" for number, drive in enumerate(dict.fromkeys(drives))}
    voxels: list[Voxels] = [{} for _ in boxes.blocks]
    for drive, copy in copies.items():
        voxels = together(voxels, write_with_boxes(drive, copy, boxes))
    return tuple(copies[drive] for drive in drives), MadeUp(boxes, tuple(voxels), n)


def score_made_up(made_up: MadeUp | None, histories: Sequence[TileHistory]) -> dict[str, Any] | None:
    """How many boxes, and how many of their voxels, the map has now and had not before; None for a run without."""
    if made_up is None:
        return None
    before = {history.tile.tile: history.before for history in histories}
    after = {history.tile.tile: history.after for history in histories}
    found = [_found(one, before, after) for one in made_up.voxels]
    return {
        "asked": made_up.asked,
        "boxes": len(found),
        "boxes_in_map": sum(n > IN_MAP_SHARE * of for n, of in found),
        "voxels": sum(of for _, of in found),
        "voxels_in_map": sum(n for n, _ in found),
        "changes_elsewhere": _elsewhere(made_up.boxes, before, after),
    }


def _found(box: Voxels, before: dict[Any, Any], after: dict[Any, Any]) -> tuple[int, int]:
    """How many voxels of a box that were not in the map are there now, and of how many."""
    n = of = 0
    for tile, voxel_id in box.items():
        fresh = voxel_id if tile not in before else voxel_id[~np.isin(voxel_id, before[tile].voxel_id)]
        of += len(fresh)
        n += 0 if tile not in after else int(np.isin(fresh, after[tile].voxel_id).sum())
    return n, of


def _elsewhere(boxes: MadeUpBoxes, before: dict[Any, Any], after: dict[Any, Any]) -> int:
    """Voxels that the run changed far from every box."""
    shown = ellipsoids_of_maps(boxes.frame, before, after)
    changed_m = shown.mean_m[shown.change_class != ChangeClass.NORMAL, :2]
    middles_m = np.array([(block.x_m, block.y_m) for block in boxes.blocks])
    near = (np.linalg.norm(changed_m[:, None] - middles_m[None], axis=2) < AROUND_M).any(axis=1)
    return int((~near).sum())


def made_up_lines(score: dict[str, Any] | None) -> list[str]:
    """The score for people."""
    if score is None:
        return []
    boxes, asked = score["boxes"], score["asked"]
    fewer = f" ({asked} were asked for, no more bare places)" if boxes < asked else ""
    return [
        f"made-up boxes: {score['boxes_in_map']} of {boxes}{fewer} are in the map now, {score['voxels_in_map']} of"
        f" their {score['voxels']} voxels; voxels changed elsewhere: {score['changes_elsewhere']}"
    ]
