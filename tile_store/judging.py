"""What somebody decides about a change of the map: looked at, taken back, taken back and its reports doubted.

A change is some voxels of some tiles, between two versions of each. Each decision is one transaction, and is written
down with who and why. It counts for the versions that were looked at: where a tile has another by now, nothing is done.
"""

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from gnd.gnd_map.features import is_feature_layer
from gnd.gnd_map.gaussian import Gaussians, concat
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store import sql_trials as trials
from gnd.tile_store import sql_versions as versions
from gnd.tile_store.connection import SqlConnection, fetch
from gnd.tile_store.errors import ChangedMeanwhile, StoreError, UnknownVersion
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.values import Content

Judgement = Literal["accepted", "doubted", "rolled back"]
LONGEST_WHY: Final = 500
LONGEST_WHO: Final = 120
_WHY: Final = re.compile(r"change ([0-9a-f]{16}): (.*)", re.DOTALL)


@dataclass(frozen=True, slots=True)
class ChangedTile:
    """What a change is in one tile.

    Attributes:
        tile: which.
        before: the version before the change; 0: the tile was not there.
        version: the newest version, in which the change was looked at.
        voxels: ids of the changed voxels, ascending.
        report_ids: of the reports that said so.
    """

    tile: TileId
    before: int
    version: int
    voxels: tuple[int, ...]
    report_ids: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not 0 <= self.before < self.version:
            raise StoreError(f"tile {self.tile.path}: version {self.before} is not before {self.version}")
        if not self.voxels or any(b <= a for a, b in zip(self.voxels, self.voxels[1:], strict=False)):
            raise StoreError(f"tile {self.tile.path}: {len(self.voxels)} voxels, need some, ascending")


@dataclass(frozen=True, slots=True)
class MapChange:
    """A change of the map: what became of some voxels, tile by tile.

    Attributes:
        layer: of Gaussians.
        what: became of them: "new", "deleted", "modified".
        tiles: by number, each once.
    """

    layer: str
    what: str
    tiles: tuple[ChangedTile, ...]

    def __post_init__(self) -> None:
        numbers = [one.tile.morton for one in self.tiles]
        if is_feature_layer(self.layer) or not numbers or numbers != sorted(set(numbers)):
            raise StoreError(f"a change of layer {self.layer!r} in {len(numbers)} tiles: of Gaussians, each tile once")

    @property
    def key(self) -> str:
        """Names the change as long as it is of the same voxels; one that grows has another name."""
        told = hashlib.sha256(f"{self.layer}|{self.what}".encode())
        for one in self.tiles:
            told.update(f"|{one.tile.morton}:".encode() + np.asarray(one.voxels, "<i4").tobytes())
        return told.hexdigest()[:16]


@dataclass(frozen=True, slots=True)
class JudgedChange:
    """A decision that was written down.

    Attributes:
        key: of the change.
        at_ns: UTC.
        who: decided.
        judgement: what.
        why: for who looks later; "": nobody said.
        tiles: numbers of the tiles that it was about.
    """

    key: str
    at_ns: int
    who: str
    judgement: str
    why: str
    tiles: tuple[int, ...]


def accept(store: SqlStore, one: MapChange, who: str, why: str) -> None:
    """Somebody has looked at a change and finds it right; the map stays as it is.

    Raises:
        ChangedMeanwhile: a tile has another version by now.
        StoreError: who or why are too long.
    """
    _check_words(who, why)

    def work(c: SqlConnection, now: int) -> None:
        for part in one.tiles:
            _check_head(c, one.layer, part)
            _write(c, one, part.tile, part.version, (who, "accepted", why), now)

    store.transact(work)


def take_back(store: SqlStore, one: MapChange, who: str, why: str, *, doubt: bool = False) -> dict[TileId, int]:
    """The voxels of a change become what they were before it, in a new version of each of its tiles; all else stays.

    As after every rollback a new epoch begins: reports that came before count no more. With `doubt` those behind the
    change are doubted, as `gnd release withdraw` does: what their vehicles alone claim in these tiles waits for others,
    until `gnd release clear`.

    Returns:
        The new version of each tile.

    Raises:
        ChangedMeanwhile: a tile has another version by now.
        UnknownVersion: retention has removed what was before.
        StoreError: who or why are too long; no report behind the change is known.
    """
    _check_words(who, why)
    contents = [Content.of(_without(store, one.layer, part)) for part in one.tiles]
    said: Judgement = "doubted" if doubt else "rolled back"

    def work(c: SqlConnection, now: int) -> dict[TileId, int]:
        made = {}
        for part, content in zip(one.tiles, contents, strict=True):
            _check_head(c, one.layer, part)
            done = versions.put_base(c, one.layer, part.tile, content, "rollback", now, signing=store.signing)
            made[part.tile] = done.version
            _write(c, one, part.tile, done.version, (who, said, why), now)
        if doubt and not sum(_doubt(c, one.layer, part, made[part.tile], now) for part in one.tiles):
            raise StoreError("no report behind this change is known (any more): roll it back instead")
        return made

    return store.transact(work)


def judged(store: SqlStore, layer: str, tiles: Sequence[TileId]) -> list[JudgedChange]:
    """What was decided about changes in some tiles, newest first; of a change in several tiles once."""
    rows = store.look(lambda c: [(tile, one) for tile in tiles for one in trials.steered(c, layer, tile)])
    found: dict[tuple[str, int, str, str, str], list[int]] = {}
    for tile, one in rows:
        told = _WHY.fullmatch(one.why)
        if told is not None:
            found.setdefault((told[1], one.at_ns, one.who, one.action, told[2]), []).append(tile.morton)
    listed = [JudgedChange(*decision, tuple(sorted(numbers))) for decision, numbers in found.items()]
    return sorted(listed, key=lambda one: (-one.at_ns, one.key))


def _without(store: SqlStore, layer: str, part: ChangedTile) -> Tile:
    """A tile as it is now, its changed voxels as they were."""
    now = store.get(layer, part.tile, part.version)
    old = store.get(layer, part.tile, part.before) if part.before else None
    if now is None or (part.before and old is None):
        lacking = part.version if now is None else part.before
        raise UnknownVersion(f"tile {part.tile.path} of layer {layer} has no version {lacking} any more")
    stays = now.decode_gaussians().gaussians
    stays = stays.take(~np.isin(stays.voxel_id, part.voxels))
    was = Gaussians.empty() if old is None else old.decode_gaussians().gaussians.select(list(part.voxels))
    whole = concat([stays, was])
    return Tile(part.tile, part.version + 1, whole.take(np.argsort(whole.voxel_id)))


def _check_head(c: SqlConnection, layer: str, part: ChangedTile) -> None:
    rows = fetch(c, "head", {"layer": layer, "tile": part.tile.morton})
    newest = rows[0][0] if rows else 0
    if newest != part.version:
        raise ChangedMeanwhile(
            f"tile {part.tile.path} of layer {layer} has version {newest} by now, {part.version} was looked at;"
            " nothing was done"
        )


def _doubt(c: SqlConnection, layer: str, part: ChangedTile, version: int, now: int) -> int:
    """Doubt the reports behind a change in a tile; how many of them are known."""
    trials.doubt(c, (layer, part.tile, version), part.report_ids, now)
    return sum(one.version == version for one in trials.doubted_reports(c, layer, part.tile))


def _write(
    c: SqlConnection, one: MapChange, tile: TileId, version: int, said: tuple[str, Judgement, str], now: int
) -> None:
    who, judgement, why = said
    trials.steer(c, (one.layer, tile, version), who, judgement, f"change {one.key}: {why}", now)


def _check_words(who: str, why: str) -> None:
    if not 0 < len(who) <= LONGEST_WHO or len(why) > LONGEST_WHY:
        raise StoreError(
            f"who has {len(who)} characters (1 to {LONGEST_WHO}), why has {len(why)} (at most {LONGEST_WHY})"
        )
