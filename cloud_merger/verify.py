"""Compute any version of a tile anew from its journal, and compare: the map is a pure function of what was reported."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from gnd.cloud_merger.belief import ShiftTests
from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.errors import MergerError
from gnd.cloud_merger.features.kept import FeatureContents
from gnd.cloud_merger.features.window import LayerMerger, LayerState, refuted_of, windows_of
from gnd.cloud_merger.map_parameters import digest_of, has_hearing, judges_met, text_of, with_text
from gnd.cloud_merger.memory import TileMemory
from gnd.cloud_merger.parameters import MergeParameters
from gnd.cloud_merger.statements import Report
from gnd.cloud_merger.stored import Bases, lattice_of_tile, reports_by_window
from gnd.cloud_merger.window import MergedWindow, TileState, WindowMerger, fold
from gnd.gnd_map.content import AnyTile
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.features import FeatureTile, is_feature_layer
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import SchemaError
from gnd.tile_store.store import Store
from gnd.tile_store.values import Basis, ClosedWindow, ReportRow, StoredTile, VersionInfo, counted_out

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
        assumed: digest of the parameters that were taken because the store does not say which it was merged with; "":
            it does.
    """

    layer: str
    tile: TileId
    version: int
    status: Status
    reason: str = ""
    assumed: str = ""


@dataclass(frozen=True, slots=True)
class _Journal:
    """What a version was made of: its epoch (None: it began with a merge), the reports, how its windows were merged."""

    layer: str
    tile: TileId
    version: int
    epoch: StoredTile | None
    basis: Basis
    closed: Mapping[int, ClosedWindow]
    rows: Sequence[ReportRow]

    def how(self, window: int) -> ClosedWindow:
        """How one of its windows was merged."""
        if window == self.basis.window:
            return ClosedWindow(self.basis.named, self.basis.parameters)
        how = self.closed.get(window, ClosedWindow(frozenset()))
        # who is quarantined counts in no window: all are folded anew when that changes
        return ClosedWindow(how.named - counted_out(how.named) | counted_out(self.basis.named), how.parameters)

    @property
    def windows_before(self) -> list[int]:
        """The closed ones that hold reports, in order."""
        return sorted({row.window for row in self.rows} - {self.basis.window})

    @property
    def is_told(self) -> bool:
        """Whether the store knows the parameters of all of it."""
        return all(self.how(window).parameters for window in [*self.windows_before, self.basis.window])

    def without(self, is_out: Callable[[ReportRow], bool]) -> "_Journal":
        """The same without some reports."""
        kept = [row for row in self.rows if not is_out(row)]
        return _Journal(self.layer, self.tile, self.version, self.epoch, self.basis, self.closed, kept)


class Verifier:
    """Computes versions anew, each window with the parameters that it was merged with.

    Args:
        store: only read.
        config: parameters of what was merged before stores kept them.
    """

    def __init__(self, store: Store, config: ShardConfig) -> None:
        self._store, self._config = store, config
        self._bases, self._features = Bases(store), FeatureContents(store)
        self._configs: dict[str, tuple[ShardConfig, ShiftTests]] = {}

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
            return self._checked(layer, tile, version)
        except MergerError as error:  # parameters of another release
            return Verified(layer, tile, version, "unknown", str(error))
        except GndError as error:  # a body, or parameters, that are not what their hash says
            return Verified(layer, tile, version, "differs", str(error))

    def _checked(self, layer: str, tile: TileId, version: int) -> Verified:
        stored = self._store.get(layer, tile, version=version)
        if stored is None:
            return Verified(layer, tile, version, "unknown", "the store has no such version any more")
        content = stored.decode()
        if stored.kind != "merged":
            return Verified(layer, tile, version, "given")
        journal = self._journal(stored)
        if isinstance(journal, str):
            return Verified(layer, tile, version, "unknown", journal)
        computed = self._computed(journal)
        assumed = "" if journal.is_told else digest_of(text_of(self._config))
        if computed.sha == content.sha:
            return Verified(layer, tile, version, "same", assumed=assumed)
        reason = f"the journal gives {computed.sha.hex()[:16]}…, published was {content.sha.hex()[:16]}…"
        if assumed:
            reason += f"; the store does not say with which parameters it was merged, assumed were {assumed[:16]}…"
        return Verified(layer, tile, version, "differs", reason, assumed)

    def without(
        self, layer: str, tile: TileId, version: int, is_out: Callable[[ReportRow], bool]
    ) -> tuple[int, str, AnyTile | None]:
        """A version computed without some reports: how many they are, and its content; None: why it cannot be."""
        stored = self._store.get(layer, tile, version=version)
        if stored is None or stored.kind != "merged":
            return 0, "it is a base or a rollback", None
        journal = self._journal(stored)
        if isinstance(journal, str):
            return 0, journal, None
        kept = journal.without(is_out)
        return len(journal.rows) - len(kept.rows), "", self._computed(kept)

    def _journal(self, stored: StoredTile) -> _Journal | str:
        """What a merged version was made of; a text: why that is not known any more."""
        layer, tile, version = stored.layer, stored.tile, stored.version
        basis = self._store.basis(layer, tile, version)
        if basis is None:
            return "it is older than the journal"
        if is_feature_layer(layer) and not basis.parameters:
            return "it is older than the windows of feature layers"
        epoch = _epoch_of(self._store.history(layer, tile), version)
        begun = None if epoch is None else self._store.get(layer, tile, version=epoch.version)
        of_epoch = None if epoch is None else self._store.basis(layer, tile, epoch.version)
        first = 0 if of_epoch is None else of_epoch.window
        rows = self._store.reports_of_windows(layer, tile, first, basis.window, basis.seq)
        closed = self._store.closed_windows(layer, tile)
        closed = {window: how for window, how in closed.items() if first <= window < basis.window}
        journal = _Journal(layer, tile, version, begun, basis, closed, rows)
        return self._missing(journal) or journal

    def _missing(self, journal: _Journal) -> str:
        """What the computation would need and retention has removed; "": nothing."""
        layer, tile = journal.layer, journal.tile
        known = {row.report_id for row in journal.rows}
        cited = set(self._store.provenance(layer, tile, journal.version)) - known
        if cited:
            return f"{len(cited)} reports that it rests on are gone, first {min(cited)}"
        windows = {row.window for row in journal.rows}
        emptied = [window for window in journal.closed if window not in windows]
        if emptied:
            return f"the reports of {len(emptied)} closed windows are gone, first of window {emptied[0]}"
        shas = {row.base_sha for row in journal.rows if row.base_sha}
        gone = sorted(sha.hex()[:16] for sha in shas if self._base(layer, tile, sha) is None)
        return f"{len(gone)} versions that reports refer to are gone, first {gone[0]}…" if gone else ""

    def _base(self, layer: str, tile: TileId, sha: bytes) -> object | None:
        of_features = is_feature_layer(layer)
        return self._features.content(layer, tile, sha) if of_features else self._bases.content(layer, tile, sha)

    def _with(self, parameters: str) -> tuple[ShardConfig, ShiftTests]:
        """The configuration with which a window was merged, and the shift tests made with it."""
        if parameters not in self._configs:
            config = with_text(self._config, parameters)
            self._configs[parameters] = config, ShiftTests()
        return self._configs[parameters]

    def _computed(self, journal: _Journal) -> AnyTile:
        if is_feature_layer(journal.layer):
            return self._computed_features(journal)
        return Tile(journal.tile, journal.version, self._computed_gaussians(journal))

    def _computed_gaussians(self, journal: _Journal) -> Gaussians:
        layer, tile, begun = journal.layer, journal.tile, journal.epoch
        state = TileState(Gaussians.empty() if begun is None else self._bases.decoded(begun), TileMemory())
        epoch = state.gaussians
        shas = {row.base_sha for row in journal.rows if row.base_sha}
        found = {sha: self._bases.content(layer, tile, sha) for sha in sorted(shas)}
        bases = {sha: gaussians for sha, gaussians in found.items() if gaussians is not None}
        owners = self._store.owners_of({row.vehicle for row in journal.rows})

        def parameters_of(window: int) -> MergeParameters:
            return self._with(journal.how(window).parameters)[0].merge

        said = reports_by_window(journal.rows, parameters_of, _left_out)

        def merged(window: int, reports: Sequence[Report]) -> MergedWindow:
            how = journal.how(window)
            config, shifts = self._with(how.parameters)
            merger = WindowMerger(
                config.merge,
                config.confirmation,
                shifts,
                bases,
                how.named,
                has_hearing=has_hearing(how.parameters),
                owners=owners,
                judges_met=judges_met(how.parameters),
            )
            return merger.merge(state, reports, lattice_of_tile(begun, epoch, config.codec))

        for window in journal.windows_before:
            if reports := said.get(window):  # of one that can no longer be read nothing was folded
                state = fold(state, merged(window, reports))
        return merged(journal.basis.window, said.get(journal.basis.window, [])).gaussians

    def _computed_features(self, journal: _Journal) -> FeatureTile:
        layer, tile = journal.layer, journal.tile
        state = LayerState(() if journal.epoch is None else journal.epoch.decode_features().features)
        shas = sorted({row.base_sha for row in journal.rows})
        found = {sha: self._features.content(layer, tile, sha) for sha in shas}
        bases = {sha: features for sha, features in found.items() if features is not None}
        by_window = windows_of(journal.rows)

        def merger(window: int) -> LayerMerger:
            how = journal.how(window)
            return LayerMerger(tile, self._with(how.parameters)[0].features, bases, refuted_of(how.named))

        for window in journal.windows_before:
            if (said := by_window.get(window)) is not None:
                state = merger(window).fold(state, merger(window).merge(state, said), said)
        open_window = journal.basis.window
        return FeatureTile(tile, journal.version, merger(open_window).merge(state, by_window.get(open_window)).features)


def _left_out(_row: ReportRow, _error: SchemaError) -> None:
    """The merge has told of it."""


def _epoch_of(history: Iterable[VersionInfo], version: int) -> VersionInfo | None:
    """The latest base or rollback up to a version; None: the tile began with a merge."""
    return max((one for one in history if one.kind != "merged" and one.version <= version), default=None, key=_number)


def _number(info: VersionInfo) -> int:
    return info.version
