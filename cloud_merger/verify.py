"""Compute any version of a tile anew from its journal, and compare: the map is a pure function of what was reported."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from cloud_merger.belief import ShiftTests
from cloud_merger.config import ShardConfig
from cloud_merger.memory import TileMemory
from cloud_merger.statements import Report
from cloud_merger.stored import Bases, lattice_of_tile, reports_by_window
from cloud_merger.window import TileState, WindowMerger, fold
from gnd_map.errors import GndError
from gnd_map.features import is_feature_layer
from gnd_map.gaussian import Gaussians
from gnd_map.tile import Tile
from gnd_map.tile_id import TileId
from tile_store.store import Store
from tile_store.values import Basis, ReportRow, VersionInfo

Status = Literal["same", "differs", "given", "unknown"]


@dataclass(frozen=True, slots=True)
class Verified:
    """A version of a tile, computed anew.

    Attributes:
        layer: of the map.
        tile: of the layer.
        version: of the tile.
        status: "same": the same content, bit for bit; "differs": it is not what its journal gives; "given": a base or a
            rollback, whose bytes were compared with their hash only; "unknown": it cannot be computed any more.
        reason: why it differs or is unknown.
    """

    layer: str
    tile: TileId
    version: int
    status: Status
    reason: str = ""


class Verifier:
    """Computes versions anew.

    Args:
        store: only read.
        config: the parameters of the shards that published.
    """

    def __init__(self, store: Store, config: ShardConfig) -> None:
        self._store, self._config = store, config
        self._bases, self._shifts = Bases(store), ShiftTests(config.shift)

    def heads(self, layer: str, region: str = "") -> Iterator[Verified]:
        """The newest version of every tile of a region."""
        for head in self._store.heads(layer, region):
            yield self.version(layer, head.tile, head.version)

    def history(self, layer: str, tile: TileId) -> Iterator[Verified]:
        """Every version of a tile that is still there."""
        for info in self._store.history(layer, tile):
            yield self.version(layer, tile, info.version)

    def version(self, layer: str, tile: TileId, version: int) -> Verified:
        """One version of a tile."""
        try:
            status, reason = self._checked(layer, tile, version)
        except GndError as error:  # a body that is not what its hash says
            status, reason = "differs", str(error)
        return Verified(layer, tile, version, status, reason)

    def _checked(self, layer: str, tile: TileId, version: int) -> tuple[Status, str]:
        stored = self._store.get(layer, tile, version=version)
        if stored is None:
            return "unknown", "the store has no such version any more"
        content = stored.decode()
        if stored.kind != "merged":
            return "given", ""
        if is_feature_layer(layer):
            return "unknown", f"{layer} holds features, whose merges are not kept as windows"
        basis = self._store.basis(layer, tile, version)
        if basis is None:
            return "unknown", "it is older than the journal"
        epoch = _epoch_of(self._store.history(layer, tile), version)
        first = self._first_window(layer, tile, epoch)
        rows = self._store.reports_of_windows(layer, tile, first, basis.window, basis.seq)
        missing = self._missing(layer, tile, version, rows, first, basis)
        if missing:
            return "unknown", missing
        sha = Tile(tile, version, self._computed(layer, tile, epoch, basis, rows)).sha
        reason = f"the journal gives {sha.hex()[:16]}…, published was {content.sha.hex()[:16]}…"
        return ("same", "") if sha == content.sha else ("differs", reason)

    def without(
        self, layer: str, tile: TileId, version: int, is_out: Callable[[ReportRow], bool]
    ) -> tuple[int, str, Gaussians | None]:
        """A version computed without some reports: how many they are, and its Gaussians; None: why it cannot be."""
        stored, basis = self._store.get(layer, tile, version=version), self._store.basis(layer, tile, version)
        if stored is None or stored.kind != "merged" or basis is None:
            return 0, "it is a base or a rollback, or older than the journal", None
        epoch = _epoch_of(self._store.history(layer, tile), version)
        first = self._first_window(layer, tile, epoch)
        rows = self._store.reports_of_windows(layer, tile, first, basis.window, basis.seq)
        missing = self._missing(layer, tile, version, rows, first, basis)
        if missing:
            return 0, missing, None
        kept = [row for row in rows if not is_out(row)]
        return len(rows) - len(kept), "", self._computed(layer, tile, epoch, basis, kept)

    def _first_window(self, layer: str, tile: TileId, epoch: VersionInfo | None) -> int:
        basis = None if epoch is None else self._store.basis(layer, tile, epoch.version)
        return 0 if basis is None else basis.window

    def _missing(
        self, layer: str, tile: TileId, version: int, rows: Sequence[ReportRow], first: int, basis: Basis
    ) -> str:
        """What the computation would need and retention has removed; "": nothing."""
        known = {row.report_id for row in rows}
        cited = set(self._store.provenance(layer, tile, version)) - known
        if cited:
            return f"{len(cited)} reports that it rests on are gone, first {min(cited)}"
        windows = {row.window for row in rows}
        emptied = [window for window in self._store.closed_windows(layer, tile) if first <= window < basis.window]
        emptied = [window for window in emptied if window not in windows]
        if emptied:
            return f"the reports of {len(emptied)} closed windows are gone, first of window {emptied[0]}"
        shas = {row.base_sha for row in rows if row.base_sha}
        gone = sorted(sha.hex()[:16] for sha in shas if self._bases.content(layer, tile, sha) is None)
        return f"{len(gone)} versions that reports refer to are gone, first {gone[0]}…" if gone else ""

    def _computed(
        self, layer: str, tile: TileId, epoch: VersionInfo | None, basis: Basis, rows: Iterable[ReportRow]
    ) -> Gaussians:
        begun = None if epoch is None else self._store.get(layer, tile, version=epoch.version)
        state = TileState(Gaussians.empty() if begun is None else self._bases.decoded(begun), TileMemory())
        lattice = lattice_of_tile(begun, state.gaussians, self._config.codec)
        by_window = reports_by_window(rows, self._config.merge)
        shas = {one.change.base_sha for reports in by_window.values() for one in reports if one.change.base_sha}
        found = {sha: self._bases.content(layer, tile, sha) for sha in sorted(shas)}
        bases = {sha: gaussians for sha, gaussians in found.items() if gaussians is not None}
        closed = self._store.closed_windows(layer, tile)

        def merger(named: frozenset[str]) -> WindowMerger:
            return WindowMerger(self._config.merge, self._config.confirmation, self._shifts, bases, named)

        for window in sorted(by_window):
            if window < basis.window:
                state = fold(state, merger(closed.get(window, frozenset())).merge(state, by_window[window], lattice))
        now: list[Report] = by_window.get(basis.window, [])
        return merger(basis.named).merge(state, now, lattice).gaussians


def _epoch_of(history: Iterable[VersionInfo], version: int) -> VersionInfo | None:
    """The latest base or rollback up to a version; None: the tile began with a merge."""
    return max((one for one in history if one.kind != "merged" and one.version <= version), default=None, key=_number)


def _number(info: VersionInfo) -> int:
    return info.version
