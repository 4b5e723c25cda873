"""Windows of a tile of a feature layer: merged while they are open, folded when they are closed."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from gnd.cloud_merger.features.fold import fold
from gnd.cloud_merger.features.kept import said_of
from gnd.cloud_merger.features.memory import LayerMemory
from gnd.cloud_merger.features.merge import MergedFeatures, merge_features
from gnd.cloud_merger.features.parameters import FeatureMergeParameters
from gnd.gnd_map.day import day_of
from gnd.gnd_map.features import Feature
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import SchemaError
from gnd.schemas.features import FeatureReport
from gnd.tile_store.values import ReportRow, StoredMemory

_ID_LENGTH: Final = 26  # of a report id
_NO_CODEC: Final = 0


@dataclass(frozen=True, slots=True)
class LayerWindow:
    """What was reported about a tile in a window: the parts, and the day of the newest receipt (`gnd.gnd_map.day`)."""

    reports: tuple[FeatureReport, ...]
    day: int


@dataclass(frozen=True, slots=True, eq=False)
class LayerState:
    """What a tile's closed windows have come to: the epoch's features, and the memory (None: none is folded)."""

    epoch: Sequence[Feature]
    memory: LayerMemory | None = None

    @classmethod
    def stored(cls, epoch: Sequence[Feature], memory: StoredMemory | None) -> "LayerState":
        """As a store has it.

        Raises:
            MergerError: the memory is damaged.
        """
        return cls(epoch, None if memory is None else LayerMemory.decode(memory.memory))

    def encoded(self, window: int) -> StoredMemory:
        """What the windows up to `window` have come to, for the store."""
        return StoredMemory(window, _NO_CODEC, b"", b"" if self.memory is None else self.memory.encode())


@dataclass(frozen=True, slots=True, eq=False)
class LayerMerger:
    """Merges windows of one tile.

    Attributes:
        tile: whose features.
        parameters: of the merge.
        bases: features by content hash of the versions that the reports refer to.
        refuted: reports that others contradict again and again, and whose each is.
    """

    tile: TileId
    parameters: FeatureMergeParameters
    bases: Mapping[bytes, Sequence[Feature]]
    refuted: Mapping[str, str]

    def merge(self, state: LayerState, window: LayerWindow | None) -> MergedFeatures:
        """Merge the reports of a window (None: it is empty) into what the windows before it have come to."""
        reports = () if window is None else window.reports
        return merge_features(self.tile, state.epoch, reports, self.parameters, self.bases, self.refuted, state.memory)

    def fold(self, state: LayerState, merged: MergedFeatures, window: LayerWindow) -> LayerState:
        """The state after a window that is closed."""
        return LayerState(state.epoch, fold(merged, self.parameters, window.day))


def windows_of(rows: Iterable[ReportRow]) -> dict[int, LayerWindow]:
    """What was reported, by window; what can no longer be read is left out."""
    reports: dict[int, list[FeatureReport]] = {}
    newest_ns: dict[int, int] = {}
    for row in rows:
        with suppress(SchemaError):
            reports.setdefault(row.window, []).append(said_of(row.body))
            newest_ns[row.window] = max(row.received_ns, newest_ns.get(row.window, row.received_ns))
    return {
        window: LayerWindow(tuple(some), day_of(newest_ns[window])) for window, some in sorted(reports.items()) if some
    }


def names_of(refuted: Mapping[str, str], rows: Iterable[ReportRow]) -> frozenset[str]:
    """The refuted reports that a merge has to know, as a journal keeps them: those that it reads, and of each of their
    vehicles the first, since a vehicle that was lost is not believed alone.
    """
    read = {row.report_id for row in rows}
    first: dict[str, str] = {}
    for report in sorted(refuted):
        first.setdefault(refuted[report], report)
    kept = {report for report in refuted if report in read} | set(first.values())
    return frozenset(f"{report}/{refuted[report]}" for report in kept)


def refuted_of(names: Iterable[str]) -> dict[str, str]:
    """The same reports, and whose each is."""
    return {name[:_ID_LENGTH]: name[_ID_LENGTH + 1 :] for name in sorted(names)}
