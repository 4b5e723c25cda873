"""Kept drives: what the vehicles of a finished `gnd fleet` run have sent, with the map that they drove on.

Reports are taken as they lie in the vehicles' outboxes: the first half in short, the whole report behind it. A drive
counts if all of it was compared with the map as it was before the run: what is replayed meets that map again, in
another place. Drives that had learned from others in mid-run are left out, by number.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import apsw
import numpy as np

from gnd.deploy.errors import LoadError
from gnd.deploy.run_folder import RunFolder
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport
from gnd.schemas.keys import parse_change_key
from gnd.schemas.packed import PackedReport
from gnd.tile_store.options import to_read
from gnd.tile_store.store import Store
from gnd.vehicle_agent.way import WAY_FILE

LAYER = "ndt"
_SENT = (
    "SELECT report_id, key, packed.body, report.body FROM report LEFT JOIN packed USING (report_id)"
    " WHERE key LIKE 'gnd/v%/change/ndt/%' ORDER BY report_id"
)


@dataclass(frozen=True, slots=True)
class KeptRuns:
    """Finished runs of `gnd fleet`.

    Attributes:
        changed: whose vehicles drove on a map that was older than the world.
        settled: whose vehicles drove on a map that was as the world is; None: there is none.
    """

    changed: Path
    settled: Path | None = None


@dataclass(frozen=True, slots=True, eq=False)
class KeptReport:
    """One report as its vehicle has sent it.

    Attributes:
        packed: its first half in short.
        whole: all of it.
        at_m: way of the drive at the last scan that it rests on.
    """

    packed: PackedReport
    whole: ChangeReport
    at_m: float

    @property
    def bases(self) -> tuple[tuple[TileId, bytes], ...]:
        """(tile, content hash) of the maps that it was compared with."""
        return tuple((change.tile, change.base_sha) for change in self.whole.tiles)


@dataclass(frozen=True, slots=True, eq=False)
class KeptDrive:
    """One vehicle's way along the street, its reports in the order in which they were made."""

    vehicle: str
    length_m: float
    reports: tuple[KeptReport, ...]


@dataclass(frozen=True, slots=True, eq=False)
class KeptStreet:
    """A street with its map and what vehicles reported of it.

    Attributes:
        tiles: the map before anybody had reported.
        drives: that were made against `tiles`.
        left_out: other drives of the run.
    """

    tiles: Mapping[TileId, Tile]
    drives: tuple[KeptDrive, ...]
    left_out: int

    @property
    def length_m(self) -> float:
        """Of the longest drive."""
        return max(drive.length_m for drive in self.drives)


def read_street(run: Path) -> KeptStreet:
    """The street of a finished run.

    Raises:
        LoadError: it is no run folder, or none of its drives can be replayed.
    """
    folder = RunFolder(run)
    if not folder.mark.exists() or not folder.store.exists():
        raise LoadError(f"{run} holds no run of `gnd fleet` ({folder.mark.name} or {folder.store.name} is missing)")
    with to_read(folder.store) as store:
        tiles = _tiles(store, first=True)
    homes = sorted(path.parent for path in folder.agents.glob(f"*/{WAY_FILE}"))
    found = [_drive(home) for home in homes]
    drives = tuple(drive for drive in found if drive is not None and _is_of(drive, tiles))
    if not drives:
        raise LoadError(
            f"{run}: none of its {len(homes)} drives can be replayed. Its vehicles must have kept their reports in "
            f"short and have driven on the map as it was before: `gnd fleet --headway 0` of this release"
        )
    return KeptStreet(tiles, drives, len(homes) - len(drives))


def healed_map(folder: RunFolder) -> dict[TileId, Tile]:
    """The map at the end of a run, every tile as version 1."""
    with to_read(folder.store) as store:
        return {tile: Tile(tile, 1, one.gaussians, one.day) for tile, one in _tiles(store, first=False).items()}


def _tiles(store: Store, *, first: bool) -> dict[TileId, Tile]:
    """Each tile as it was first, where that was a base, or as it is now."""
    found = {}
    for tile in (entry.tile for entry in store.heads(LAYER)):
        infos = store.history(LAYER, tile)
        version = min(info.version for info in infos) if first else max(info.version for info in infos)
        stored = store.get(LAYER, tile, version)
        content = None if stored is None or (first and stored.kind != "base") else stored.decode()
        if isinstance(content, Tile):
            found[tile] = content
    return found


def _drive(home: Path) -> KeptDrive | None:
    """What one vehicle has sent; None: not in short, or nothing."""
    t_ns, way_m = _way(home / WAY_FILE)
    connection = apsw.Connection(str(home / "outbox.sqlite"), flags=apsw.SQLITE_OPEN_READONLY)
    try:
        rows = list(connection.execute(_SENT))
    finally:
        connection.close()
    if not rows or not len(t_ns) or any(packed is None for _, _, packed, _ in rows):
        return None
    reports = [_report(str(key), bytes(packed), bytes(body), t_ns, way_m) for _, key, packed, body in rows]
    return KeptDrive(home.name, float(way_m[-1]), tuple(sorted(reports, key=lambda one: one.at_m)))


def _report(key: str, packed: bytes, body: bytes, t_ns: np.ndarray, way_m: np.ndarray) -> KeptReport:
    layer, district = parse_change_key(key)
    first, whole = PackedReport.decode(packed), ChangeReport.decode(body)
    if (whole.layer, whole.district) != (layer, district):
        raise LoadError(f"report {first.report_id} of {district} lies in its outbox under {key}")
    return KeptReport(first, whole, float(np.interp(whole.last_ns - t_ns[0], t_ns - t_ns[0], way_m)))


def _way(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Times (N,) int64 ns and way (N,) float64 m; a restarted agent has written its way twice, the last one counts."""
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    starts = [n + 1 for n, (a, b) in enumerate(pairwise(lines)) if b["t_ns"] <= a["t_ns"]]
    lines = lines[starts[-1] :] if starts else lines
    return (
        np.array([line["t_ns"] for line in lines], np.int64),
        np.array([line["odometer_m"] for line in lines], np.float64),
    )


def _is_of(drive: KeptDrive, tiles: Mapping[TileId, Tile]) -> bool:
    """Whether all of its reports were made against these tiles."""
    return all(_held(tiles, report.bases) for report in drive.reports)


def _held(tiles: Mapping[TileId, Tile], bases: Iterable[tuple[TileId, bytes]]) -> bool:
    return all(not sha or (tile in tiles and tiles[tile].sha == sha) for tile, sha in bases)


def gaussians_by_sha(tiles: Mapping[TileId, Tile]) -> dict[bytes, Gaussians]:
    """The map by content hash, as the second half of a report needs it."""
    return {tile.sha: tile.gaussians for tile in tiles.values()}
