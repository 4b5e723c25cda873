"""Reasons to doubt a tile: counted scan by scan while it is seen, reported when it is decided."""

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.day import UNKNOWN_DAY
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import GridFrame, VoxelGrid
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import TileChange
from gnd.schemas.doubt import Doubt, DoubtReason
from gnd.vehicle_agent.detect.classify import Classification
from gnd.vehicle_agent.detect.shift import Shift, no_shift
from gnd.vehicle_agent.detect.trial import Tried
from gnd.vehicle_agent.detect.uncertainty import PoseUncertainty

BAD_SHARE: Final = 0.1
"""From this share of scans with poor health, or that disagree, a tile is doubtful."""
UNCHECKED_SHARE: Final = 0.5
IMPLAUSIBLE_SHARE: Final = 0.6
"""Of the voxels that hold something, whatever time has passed: a building site leaves the road and what lies around it
(docs/decisions/0082-the-gate-on-the-vehicle.md)."""
BURST_SHARE: Final = 0.3
"""What may change from one day to the next: a market, scaffolding, snow at the roadside ..."""
SHARE_OF_YEAR: Final = 0.3
"""... and what a year adds. After a year the limit is the one without time. The same for all vehicles; no more than a
convention (docs/decisions/0093-gates-told-and-measured.md)."""
_DAYS_OF_YEAR: Final = 365.25
LEAST_OF_SHARE: Final = 50
"""So many voxels must hold something before their share counts."""
LEAST_WITHHELD: Final = 5
"""A tile of which so few voxels were seen from a wrong pose is not mentioned."""
_PERMILLE: Final = 1000
_LONGEST_MM: Final = 100_000


@dataclass(slots=True)
class TileAccount:
    """Scans that saw a tile, by what became of them."""

    scans: dict[str, int] = field(default_factory=dict)
    shift: Shift | None = None
    """The largest that a pose error was found by."""
    withheld: set[int] = field(default_factory=set)
    """Voxels that seemed to have changed in scans of a wrong pose."""
    pose: PoseUncertainty = field(default_factory=PoseUncertainty)
    explained: bool = False
    """Most of what changed in the tile is explained by `shift`."""
    off: bool = False
    """Some of it is."""

    def add(self, what: str, scans: int) -> None:
        """Count scans under what became of them."""
        self.scans[what] = self.scans.get(what, 0) + scans

    def share(self, *what: str) -> float:
        """Of all scans that saw the tile, 0 ... 1."""
        return sum(self.scans.get(name, 0) for name in what) / max(sum(self.scans.values()), 1)


class TileDoubts:
    """Remembers of each tile which scans saw it and what was wrong with them, until the tile is decided."""

    def __init__(self, grid_frame: GridFrame) -> None:
        self._grid_frame = grid_frame
        self._accounts: dict[TileId, TileAccount] = {}

    def tried(self, tried: Tried, costs: F64 | None) -> None:
        """Take a segment; of one that is shifted, the cost of each of its points at the pose as it is."""
        morton, voxel = self._tiles_of(tried.points_map_m)
        for code in np.unique(morton).tolist():
            account = self._accounts.setdefault(TileId(code), TileAccount())
            account.add(tried.verdict, tried.scans)
            if costs is None:
                continue
            account.withheld |= set(voxel[(morton == code) & (costs > 0.5)].tolist())
            if account.shift is None or tried.shift.size_m > account.shift.size_m:
                account.shift, account.pose = tried.shift, tried.pose

    def poor(self, points_map_m: F64, what: str) -> None:
        """Take some points (N, 3) of a scan that is no evidence ("uncertain"), or whose estimates "disagree"."""
        morton, _ = self._tiles_of(points_map_m)
        for code in np.unique(morton).tolist():
            self._accounts.setdefault(TileId(code), TileAccount()).add(what, 1)

    def tiles(self) -> tuple[TileId, ...]:
        """Tiles in which a pose error was found."""
        return tuple(sorted(t for t, account in self._accounts.items() if account.shift is not None))

    def all_tiles(self) -> tuple[TileId, ...]:
        """Tiles that anything is known of."""
        return tuple(sorted(self._accounts))

    def forget(self, tiles: Collection[TileId]) -> None:
        """Tiles that are left and have nothing to decide."""
        for tile in tiles:
            self._accounts.pop(tile, None)

    def take(self, tile: TileId) -> TileAccount:
        """What is known of a tile; forgotten here."""
        return self._accounts.pop(tile, TileAccount())

    def _tiles_of(self, points_map_m: F64) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        if not len(points_map_m):
            return np.empty(0, np.int64), np.empty(0, np.int32)
        A, b = self._grid_frame.affine(points_map_m.mean(axis=0))
        return self._grid_frame.tile_voxel_of(np.floor(points_map_m @ A.T + b).astype(np.int64))


def plausible_share(base_day: int, day: int) -> float:
    """How much of a tile may have changed, 0 ... 1, by the time since its version.

    Where that is not known the limit is the one without time; so it is where the clock of the vehicle, or of who dated
    the tile, must be wrong: the drive is older than what it is compared with. A clock that runs ahead makes no change
    plausible that would not be so anyway.

    Args:
        base_day: of the tile, `gnd.gnd_map.day`.
        day: of the drive.
    """
    if UNKNOWN_DAY in (base_day, day) or day < base_day:
        return IMPLAUSIBLE_SHARE
    return min(BURST_SHARE + SHARE_OF_YEAR * (day - base_day) / _DAYS_OF_YEAR, IMPLAUSIBLE_SHARE)


def doubt_of(found: Classification, account: TileAccount, day: int = UNKNOWN_DAY) -> Doubt | None:
    """Why a tile that is reported is doubtful nevertheless; None where nothing is against it, or where
    nothing has changed. `day`: of the drive, `gnd.gnd_map.day`.
    """
    reasons, changed_share = DoubtReason.NONE, changed_share_of(found)
    if not found.changed.any():
        return None
    if changed_share > plausible_share(found.evidence.base.day, day):
        reasons |= DoubtReason.IMPLAUSIBLE_SHARE
    if account.off or account.share("uncertain", "shifted") >= BAD_SHARE:
        reasons |= DoubtReason.HEALTH_NOT_GOOD
    if account.share("disagree") >= BAD_SHARE:
        reasons |= DoubtReason.ESTIMATES_DISAGREE
    if account.share("unchecked") > UNCHECKED_SHARE:
        reasons |= DoubtReason.POSE_NOT_CHECKED
    return _doubt(reasons, account, changed_share) if reasons else None


def changed_share_of(found: Classification) -> float:
    """Of the voxels that hold something in the base or now, those that are changed; 0 where there are too few. What
    lies beyond the map extends it and does not count, unless there is no map at all.
    """
    beyond = int(beyond_map(found).sum()) if len(found.evidence.base.gaussians) else 0
    changed = int(found.changed.sum()) - beyond
    holding = changed + int((found.change_class == ChangeClass.NORMAL).sum())
    return changed / holding if holding >= LEAST_OF_SHARE else 0.0


def withheld_change(base: Tile, account: TileAccount, changed_share: float = 0.0) -> TileChange:
    """A tile that is not reported, because a pose error explains what seems to have changed."""
    nothing = Gaussians.empty()
    return TileChange(
        tile=base.tile_id,
        base_version=base.version,
        base_sha=base.sha if base.version else b"",
        observed=nothing.voxel_id,
        changed=nothing,
        change_class=np.empty(0, np.uint8),
        evidence=np.empty((0, 4), np.int32),
        pose_sigma_m=account.pose.sigma_m,
        pose_sigma_rad=account.pose.sigma_rad,
        doubt=_doubt(DoubtReason.EXPLAINED_BY_SHIFT, account, changed_share, withheld=max(len(account.withheld), 1)),
    )


def _doubt(reasons: DoubtReason, account: TileAccount, changed_share: float, withheld: int = 0) -> Doubt:
    shift = account.shift or no_shift()
    mm = np.clip(np.rint(shift.shift_m * 1e3), -_LONGEST_MM, _LONGEST_MM).astype(int).tolist()
    return Doubt(
        reasons=reasons,
        withheld=withheld,
        explained_permille=round(shift.explained_share * _PERMILLE),
        changed_permille=round(changed_share * _PERMILLE),
        uncertain_permille=round(account.share("uncertain", "shifted") * _PERMILLE),
        forward_mm=mm[0],
        left_mm=mm[1],
        up_mm=mm[2],
        turn_10urad=round(float(shift.turn_rad[2]) * 1e5),
    )


def beyond_map(found: Classification) -> NDArray[np.bool_]:
    """(K,) the new voxels in whose column, and in the eight around it, the map of the tile holds nothing.

    They extend the map, and are no evidence against the pose or the map. A survey that saw a place met something there,
    the ground at least: where the map holds nothing above, below or beside, it has not been surveyed (ground behind the
    last house, behind what has gone since, beyond the end of the survey's road).
    """
    base = found.evidence.base
    grid = VoxelGrid.of(base.tile_id)
    near = np.zeros((grid.nx + 2, grid.ny + 2), np.bool_)
    x, y, _ = grid.unravel(base.gaussians.voxel_id)
    for dx in range(3):
        for dy in range(3):
            near[x + dx, y + dy] = True
    x, y, _ = grid.unravel(found.evidence.voxel_id)
    return np.asarray((found.change_class == ChangeClass.NEW) & ~near[x + 1, y + 1])
