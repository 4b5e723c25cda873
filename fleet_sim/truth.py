"""What truly changed in a world: one class a voxel, and the masks of the three levels at which predictions are scored.

The rules below compare geometry and visibility, nothing else; no threshold, similarity or evidence of the method enters
them. They were fixed before the method was tuned, and tests pin them.

Existence. A voxel holds a Gaussian when 20 of its sub-cells are occupied, the one rule of the project
(`gnd_map.accumulate`). Before: what the scan of `before` hits. After: what the scan of `after` hits, together with what
was hit before and still stands, though perhaps hidden now: nothing is deleted by being hidden. What a vanished thing
has revealed is new to the map.

Modified. A voxel with both Gaussians is modified when a quarter of its sub-cells lie on surfaces that went or came,
farther than one sub-cell (10 to 20 cm) from every surface of the other state.

Seasons. Leaves and snow ("seasonal" things of a world) that come or go change no map: leaves that are gone count as
standing still, those that came as nothing. What they hid and reveal follows the rule above. `seasonal` tells which
voxels they touch: whoever calls one of those changed has followed the season, and that is counted apart.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim import dense_scan
from gnd.fleet_sim.dense_scan import DenseScan, ScanPlan
from gnd.fleet_sim.errors import TruthError
from gnd.fleet_sim.world import STATES, World, to_json
from gnd.gnd_map.accumulate import N_MIN_CELLS
from gnd.gnd_map.bounded import json_value, npz_arrays
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame, zones
from gnd.gnd_map.tile_id import TileId

Level = Literal["observable", "all", "scored"]
"""*observable*: near enough, and visible after the changes, marginal ones too; it leads. *all*: every voxel that a ray
touched. *scored*: observable ones whose class no hair decides."""
LEVELS: Final[tuple[Level, ...]] = get_args(Level)
CHANGES: Final = (ChangeClass.NEW, ChangeClass.MODIFIED, ChangeClass.DELETED)
"""The three classes of change."""
BoolArray = NDArray[np.bool_]

_FORMAT: Final = "gnd.truth"
_VERSION: Final = 2
MAX_BYTES: Final = 1 << 31
"""Of all arrays of a truth file, unpacked."""


@dataclass(frozen=True, slots=True)
class TruthRules:
    """Fixed criteria. Changing one makes all earlier scores incomparable.

    Attributes:
        n_min_cells: occupied sub-cells from which on a voxel holds a Gaussian.
        modified_share: share of changed sub-cells from which on a voxel is modified.
        marginal_share: between these shares, "modified" is decided by a hair.
        marginal_cells: between these counts of sub-cells, existence is decided by a hair.
        shell_cells: so many sub-cells of surface touching an unoccupied voxel from outside let noise decide.
        revealed_share: so much of a kept surface seen only after makes "normal" doubtful.
        reach_m: observable voxels lie within this distance of the road's middle (plus a lane).
        end_m: and at least so far inside the street's ends.
        low_m, high_m: and between these heights over the road.
        seen_cells: sub-cells of an observable Gaussian that are visible after.
        passes: followed rays that pass after through an observable voxel without a Gaussian.
    """

    n_min_cells: int = N_MIN_CELLS
    modified_share: float = 0.25
    marginal_share: tuple[float, float] = (0.125, 0.5)
    marginal_cells: tuple[int, int] = (10, 40)
    shell_cells: int = 10
    revealed_share: float = 0.25
    reach_m: float = 20.0
    end_m: float = 5.0
    low_m: float = -1.0
    high_m: float = 8.0
    seen_cells: int = 40
    passes: int = 30


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The truth of one world, for V voxels that rays of the dense scan touched.

    Attributes:
        world_sha: SHA-256 of the world's file, hexadecimal.
        plan: how densely it was scanned.
        frame: the world's map frame.
        morton: int64 (V,), tile of each voxel.
        voxel_id: int32 (V,), voxel in its tile; sorted by (morton, voxel_id).
        change_class: uint8 (V,), a `ChangeClass` from NORMAL to EMPTY.
        clear: bool (V,), not marginal.
        observable: bool (V,), near enough and visible.
        seasonal: bool (V,), leaves or snow that come or go were met there in either state.
        before: Gaussians of the state before.
        after: Gaussians of what stands after.
    """

    world_sha: str
    plan: ScanPlan
    frame: LocalFrame
    morton: NDArray[np.int64]
    voxel_id: NDArray[np.int32]
    change_class: NDArray[np.uint8]
    clear: BoolArray
    observable: BoolArray
    seasonal: BoolArray
    before: Mapping[TileId, Gaussians] = field(repr=False)
    after: Mapping[TileId, Gaussians] = field(repr=False)

    def __post_init__(self) -> None:
        sizes = {
            len(a) for a in (self.morton, self.voxel_id, self.change_class, self.clear, self.observable, self.seasonal)
        }
        if len(sizes) != 1:
            raise TruthError(f"truth columns have different lengths: {sorted(sizes)}")
        if len(self.change_class) and self.change_class.max() > ChangeClass.EMPTY:
            raise TruthError(f"truth holds class {self.change_class.max()}, the last is {int(ChangeClass.EMPTY)}")

    def __len__(self) -> int:
        return len(self.morton)

    def mask(self, level: Level) -> BoolArray:
        """Return which voxels count at a level, bool (V,).

        Raises:
            TruthError: no such level.
        """
        if level not in LEVELS:
            raise TruthError(f"unknown level {level!r}, use one of {', '.join(LEVELS)}")
        if level == "all":
            return np.ones(len(self), np.bool_)
        return self.observable if level == "observable" else self.clear & self.observable

    def counts(self, level: Level) -> dict[str, int]:
        """Return the number of voxels of each class at a level, by lower-case class name."""
        found = np.bincount(self.change_class[self.mask(level)], minlength=len(ChangeClass))
        return {c.name.lower(): int(found[c]) for c in ChangeClass if c is not ChangeClass.UNMEASURED}


def world_sha(world: World) -> str:
    """Return the SHA-256 of a world's file, hexadecimal."""
    return hashlib.sha256(to_json(world).encode()).hexdigest()


def make_truth(world: World, rules: TruthRules | None = None, plan: ScanPlan | None = None) -> Truth:
    """Scan a world densely in both states and classify every voxel (some 10 s for 200 m of street).

    Args:
        world: the street.
        rules: the fixed criteria; others only for experiments.
        plan: where the scan looks from.
    """
    rules, plan = rules or TruthRules(), plan or ScanPlan()
    parts = [_truth_of_zone(world, scan, rules, plan) for scan in dense_scan.dense_scans(world, plan)]
    return parts[0] if len(parts) == 1 else _joined_zones(parts)


def _truth_of_zone(world: World, scan: DenseScan, rules: TruthRules, plan: ScanPlan) -> Truth:
    classes = classify(scan, rules)
    morton, voxel_id = scan.grid_frame.tile_voxel_of(scan.g.astype(np.int64))
    order = np.lexsort((voxel_id, morton))
    clear, observable = ~marginal(scan, rules), observed(world, scan, classes, rules)
    return Truth(
        world_sha=world_sha(world),
        plan=plan,
        frame=world.frame,
        morton=morton[order],
        voxel_id=voxel_id[order],
        change_class=classes[order],
        clear=clear[order],
        observable=observable[order],
        seasonal=scan.count(dense_scan.SEASONAL)[order] > 0,
        before=scan.before.finish(rules.n_min_cells),
        after=scan.after.finish(rules.n_min_cells),
    )


def _joined_zones(parts: Sequence[Truth]) -> Truth:
    """The truths of several zones of latitude, which have no tile in common, as one."""
    columns: dict[str, Any] = {name: _joined(getattr(part, name) for part in parts) for name in _COLUMNS}
    order = np.lexsort((columns["voxel_id"], columns["morton"]))
    columns = {name: column[order] for name, column in columns.items()}
    for state in STATES:
        merged = {tile: g for part in parts for tile, g in getattr(part, state).items()}
        columns[state] = dict(sorted(merged.items()))
    return replace(parts[0], **columns)


def classify(scan: DenseScan, rules: TruthRules) -> NDArray[np.uint8]:
    """Return the class of each voxel, uint8 (V,), see the module's head."""
    before = scan.count(dense_scan.KNOWN_BEFORE) >= rules.n_min_cells
    after = scan.count(dense_scan.STANDS_AFTER) >= rules.n_min_cells
    modified = before & after & (_changed_share(scan) >= rules.modified_share)
    cases = [(modified, ChangeClass.MODIFIED), (before & after, ChangeClass.NORMAL)]
    cases += [(before, ChangeClass.DELETED), (after, ChangeClass.NEW)]
    return np.select([c for c, _ in cases], [int(k) for _, k in cases], int(ChangeClass.EMPTY)).astype(np.uint8)


def marginal(scan: DenseScan, rules: TruthRules) -> BoolArray:
    """Return which voxels, bool (V,), have a class that a hair decides."""
    low, high = rules.marginal_cells
    found = np.zeros(len(scan.g), dtype=np.bool_)
    for state, flags in enumerate((dense_scan.KNOWN_BEFORE, dense_scan.STANDS_AFTER)):
        count = scan.count(flags)
        found |= (count >= low) & (count < high)
        found |= (count < rules.n_min_cells) & (scan.shell[:, state] >= rules.shell_cells)
    share = _changed_share(scan)
    found |= (share >= rules.marginal_share[0]) & (share < rules.marginal_share[1])
    revealed = scan.unexplained[:, 2] >= rules.revealed_share * np.maximum(scan.count(dense_scan.STANDS_AFTER), 1)
    return np.asarray(found | (revealed & (scan.count(dense_scan.KNOWN_BEFORE) >= rules.n_min_cells)))


def observed(world: World, scan: DenseScan, classes: NDArray[np.uint8], rules: TruthRules) -> BoolArray:
    """Return which voxels, bool (V,), are near enough to the lanes and were visible after the changes."""
    close = near(world, world.street_of_map(scan.grid_frame.centre_map_m(scan.g)), rules)
    seen = scan.count(dense_scan.AFTER_KEPT | dense_scan.AFTER_COME) >= rules.seen_cells
    gone = (classes == ChangeClass.DELETED) | (classes == ChangeClass.EMPTY)
    free = scan.passes[:, 1] >= rules.passes
    fallen = (
        scan.count(dense_scan.LEAF_BEFORE) > 0
    ) & free  # leaves that count as standing, but can be seen to be gone
    return np.asarray(close & np.where(gone, free, seen | fallen))


def near(world: World, centre_street: NDArray[np.float64], rules: TruthRules) -> BoolArray:
    """Return which points (N, 3) of the street frame are near enough to the lanes, bool (N,)."""
    found = np.abs(centre_street[:, 1]) <= rules.reach_m + world.lane_offset_m
    found &= np.abs(centre_street[:, 0]) <= world.half_length_m - rules.end_m
    above = centre_street[:, 2] - world.relief_m(centre_street[:, 0])
    return np.asarray(found & (above >= rules.low_m) & (above <= rules.high_m))


def _changed_share(scan: DenseScan) -> NDArray[np.float64]:
    gone = scan.unexplained[:, 0] / np.maximum(scan.count(dense_scan.KNOWN_BEFORE), 1)
    come = scan.unexplained[:, 1] / np.maximum(scan.count(dense_scan.STANDS_AFTER), 1)
    return np.asarray(np.maximum(gone, come))


def write_truth(truth: Truth, path: Path) -> None:
    """Write a truth as .npz; the file appears complete or not at all.

    Raises:
        TruthError: it cannot be written.
    """
    partial = path.with_name(f".{path.name}.part")
    head: dict[str, object] = {"format": _FORMAT, "version": _VERSION, "world_sha": truth.world_sha}
    head |= {"rules": asdict(TruthRules()), "plan": asdict(truth.plan)}
    frame = truth.frame
    arrays: dict[str, Any] = {name: getattr(truth, name) for name in _COLUMNS}
    arrays |= {"head": np.array(json.dumps(head)), "anchor": np.array([frame.lat_rad, frame.lon_rad, frame.height_m])}
    arrays |= _packed("before", truth.before) | _packed("after", truth.after)
    try:
        with partial.open("wb") as file:
            np.savez_compressed(file, **arrays)
        partial.replace(path)
    except OSError as error:
        raise TruthError(f"cannot write the truth file {path}: {error}") from error


def read_truth(path: Path) -> Truth:
    """Read a truth file.

    Raises:
        TruthError: it is missing, damaged, or made by other rules.
    """
    try:
        return _truth_in(path)
    except TruthError:
        raise
    except Exception as error:  # a damaged archive leads to any of numpy's, zipfile's, zlib's and tokenize's
        reason = f"{type(error).__name__}: {error}"
        raise TruthError(f"cannot read the truth file {path}: {reason[:300]}") from error


def _truth_in(path: Path) -> Truth:
    with path.open("rb") as stream:
        data = npz_arrays(stream, MAX_BYTES)
    head = json_value(str(data["head"]))
    if (head.get("format"), head.get("version")) != (_FORMAT, _VERSION):
        raise TruthError(f"{path} is no truth file of version {_VERSION}")
    if head["rules"] != json.loads(json.dumps(asdict(TruthRules()))):
        raise TruthError(f"{path} was made by other rules than this program's: delete it, it will be made again")
    columns: dict[str, Any] = {name: data[name] for name in _COLUMNS}
    columns |= {state: _unpacked(state, data) for state in ("before", "after")}
    columns["plan"] = ScanPlan(**head["plan"])
    return Truth(world_sha=head["world_sha"], frame=LocalFrame(*data["anchor"].tolist()), **columns)


def load_or_make_truth(world: World, path: Path, plan: ScanPlan | None = None) -> Truth:
    """Return the truth of a world from its file, made first if the file is missing or belongs to another world or plan.

    Raises:
        TruthError: the file cannot be written.
    """
    plan = plan or ScanPlan()
    if path.exists():
        try:
            kept = read_truth(path)
        except TruthError:
            kept = None
        if kept is not None and (kept.world_sha, kept.plan) == (world_sha(world), plan):
            return kept
    truth = make_truth(world, plan=plan)
    write_truth(truth, path)
    return truth


_COLUMNS: Final = ("morton", "voxel_id", "change_class", "clear", "observable", "seasonal")
_GAUSSIAN_COLUMNS: Final = ("voxel_id", "count", "cells", "mean_m", "cov_m2")


def _packed(state: str, tiles: Mapping[TileId, Gaussians]) -> dict[str, NDArray[Any]]:
    """Columns of all tiles one after the other, with the tile of each row."""
    owners = [np.full(len(g), tile.morton, np.int64) for tile, g in tiles.items()]
    columns = {name: _joined(getattr(g, name) for g in tiles.values()) for name in _GAUSSIAN_COLUMNS}
    return {f"{state}_morton": _joined(owners), **{f"{state}_{name}": column for name, column in columns.items()}}


def _joined(arrays: Iterable[NDArray[Any]]) -> NDArray[Any]:
    return np.concatenate(list(arrays))


def _unpacked(state: str, data: Mapping[str, NDArray[Any]]) -> dict[TileId, Gaussians]:
    owner = data[f"{state}_morton"]
    rows = {int(code): np.flatnonzero(owner == code) for code in np.unique(owner)}
    columns = [data[f"{state}_{name}"] for name in _GAUSSIAN_COLUMNS]
    return {TileId(code): Gaussians(*(column[index] for column in columns)) for code, index in rows.items()}


def grids_of(truth: Truth) -> tuple[GridFrame, ...]:
    """Return the grid frames of a truth's tiles in the world's map frame, one for each zone of latitude."""
    tiles = [TileId(int(code)) for code in np.unique(truth.morton)]
    return tuple(GridFrame.around(truth.frame, group) for group in zones(tiles).values())


def grid_of(truth: Truth) -> GridFrame:
    """Return the grid frame of a truth that lies in one zone of latitude.

    Raises:
        TruthError: it lies in several; see `grids_of`.
    """
    grids = grids_of(truth)
    if len(grids) != 1:
        raise TruthError(f"the truth lies in {len(grids)} zones of latitude, each with a grid of its own")
    return grids[0]
