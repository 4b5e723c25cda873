"""What lies in the store, as the merge reads it: the statements of reports, and tiles by version; both remembered."""

from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import lru_cache
from threading import Lock
from typing import Final

from gnd.cloud_merger.memory import TileMemory
from gnd.cloud_merger.parameters import MergeParameters
from gnd.cloud_merger.statements import Report
from gnd.cloud_merger.window import TileState
from gnd.gnd_map.by_object import ByObject
from gnd.gnd_map.codec import (
    CODEC_ARCHIVE_ZSTD,
    CODEC_COMPACT_ZSTD,
    CODEC_FLOAT32_ZSTD,
    CODEC_STANDARD_ZSTD,
    Lattice,
    best_codec,
    codec_of,
    is_on,
    lattice_of,
)
from gnd.gnd_map.content import AnyTile
from gnd.gnd_map.features import is_feature_layer
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.doubt import DoubtReason
from gnd.schemas.errors import SchemaError
from gnd.tile_store.store import Store
from gnd.tile_store.values import ReportRow, StoredMemory, StoredTile, TileJournal, lattice_named

REMEMBERED_REPORTS: Final = 4096  # some 20 kB each
NEW_GROUND: Final = DoubtReason.IMPLAUSIBLE_SHARE | DoubtReason.POSE_NOT_CHECKED
_STATE_CODECS: Final = (CODEC_STANDARD_ZSTD, CODEC_COMPACT_ZSTD, CODEC_ARCHIVE_ZSTD, CODEC_FLOAT32_ZSTD)  # quick ones
REMEMBERED_TILES: Final = 1024  # some 120 kB each
REMEMBERED_STATES: Final = 256  # some 200 kB each


class _Said:
    """Reports by their bytes, those used last. Safe in several threads."""

    def __init__(self, most: int) -> None:
        self._most, self._lock = most, Lock()
        self._held: OrderedDict[bytes, ChangeReport] = OrderedDict()

    def of(self, body: bytes) -> ChangeReport:
        with self._lock:
            found = self._held.get(body)
            if found is not None:
                self._held.move_to_end(body)
                return found
        report = ChangeReport.decode(body)
        self.put(body, report)
        return report

    def put(self, body: bytes, report: ChangeReport) -> None:
        with self._lock:
            self._held[body] = report
            if len(self._held) > self._most:
                self._held.popitem(last=False)


_SAID: Final = _Said(REMEMBERED_REPORTS)


def said(body: bytes) -> ChangeReport:
    """A stored report, which has one tile; remembered: each merge of a tile reads all reports again.

    Raises:
        SchemaError: it can no longer be read.
    """
    return _SAID.of(body)


def encoded_parts(report: ChangeReport) -> tuple[tuple[TileId, bytes], ...]:
    """`split`, remembered: what is put into the journal here is merged here soon. A report is what its bytes say, to
    the bit, so nothing depends on who has decoded it.
    """
    parts = []
    for change in report.tiles:
        one = replace(report, tiles=(change,))
        body = one.encode()
        _SAID.put(body, one)
        parts.append((change.tile, body))
    return tuple(parts)


_REPORTS: Final[ByObject[tuple[MergeParameters, Report]]] = ByObject(REMEMBERED_REPORTS)
"""The parameters are held with what they have made, so that no others get their id."""


def report_of(body: bytes, parameters: MergeParameters, received_ns: int = 0) -> Report:
    """The same as the merge takes it; the same object, as long as it is remembered.

    Raises:
        SchemaError: it can no longer be read.
    """
    report = said(body)
    key = id(parameters), received_ns
    return _REPORTS.of(report, lambda: (parameters, _weighed(report, parameters, received_ns)), key)[1]


def _weighed(report: ChangeReport, parameters: MergeParameters, received_ns: int) -> Report:
    (change,) = report.tiles
    weighed = parameters.report_of(report.report_id, report.sensor_model, change)
    return replace(
        weighed,
        vehicle=report.vehicle,
        first_ns=report.first_ns,
        last_ns=report.last_ns,
        is_doubtful=is_doubtful(change),
        course=report.course,
        received_ns=received_ns,
    )


_OF_ROWS: Final[ByObject[tuple[MergeParameters, Report]]] = ByObject(REMEMBERED_REPORTS)


def report_of_row(row: ReportRow, parameters: MergeParameters) -> Report:
    """`report_of` a row, by the very row.

    Raises:
        SchemaError: it can no longer be read.
    """
    return _OF_ROWS.of(row, lambda: (parameters, report_of(row.body, parameters, row.received_ns)), id(parameters))[1]


def reports_by_window(
    rows: Iterable[ReportRow],
    parameters_of: Callable[[int], MergeParameters],
    unreadable: Callable[[ReportRow, SchemaError], object],
) -> dict[int, list[Report]]:
    """The reports by window, each read with the parameters of its window; of one that came in two parts the second, if
    it is there. `rows`: by id and part.

    What can no longer be read is left out, and `unreadable` is told.
    """
    found: dict[int, dict[str, Report]] = {}
    for row in rows:
        try:
            found.setdefault(row.window, {})[row.report_id] = report_of_row(row, parameters_of(row.window))
        except SchemaError as error:
            unreadable(row, error)
    return {window: list(reports.values()) for window, reports in found.items()}


def lattice_of_tile(epoch: StoredTile | None, gaussians: Gaussians, codec: str) -> Lattice | None:
    """Where the merged tile lies: on the lattice of the epoch; a tile that the map has not yet, on the configured one.

    The epoch lies on the configured one wherever that can be (few Gaussians may lie on several), and a map of plain
    floats stays one: so every version is as fine as the base map was made.
    """
    configured = lattice_named(codec)
    if epoch is None or len(gaussians) == 0:
        return configured
    is_there = configured is not None and _ON.of(gaussians, lambda: is_on(gaussians, configured), codec)
    return configured if is_there else lattice_of(epoch.codec_id)


_ON: Final[ByObject[bool]] = ByObject(REMEMBERED_TILES)


def is_doubtful(change: TileChange) -> bool:
    """Whether the vehicle does not fully believe what it says. That all has changed, and that nothing could be checked,
    is in the nature of ground that no map shows yet.
    """
    if change.doubt is None:
        return False
    excused = 0 if change.base_sha else int(NEW_GROUND)
    return int(change.doubt.reasons) & ~excused != 0  # as numbers: reasons of a newer vehicle have no names here


def encode_state(tile: TileId, window: int, state: TileState) -> StoredMemory:
    """What a tile's windows up to `window` have come to, for the store."""
    codec_id = best_codec(state.gaussians, _STATE_CODECS)
    return StoredMemory(window, codec_id, codec_of(codec_id).encode(tile, state.gaussians), state.memory.encode())


@lru_cache(maxsize=REMEMBERED_STATES)
def decode_state(tile: TileId, stored: StoredMemory) -> TileState:
    """The same, as it was; the same object, as long as it is remembered.

    Raises:
        MergerError, CodecError: it is damaged.
    """
    return TileState(codec_of(stored.codec_id).decode(tile, stored.body), TileMemory.decode(stored.memory))


class Bases:
    """Versions of tiles, decoded; their contents are remembered by hash, those used last. Safe in several threads.

    Args:
        store: that holds them.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._lock = Lock()
        self._held: OrderedDict[tuple[TileId, bytes], Gaussians] = OrderedDict()
        self._versions: OrderedDict[tuple[str, TileId, int], Tile] = OrderedDict()  # a version never changes

    def version(self, layer: str, tile: TileId, version: int) -> Tile | None:
        """A version of a tile; None: the store does not hold it. Version 0: the vehicle had no map, so no Gaussians."""
        if version == 0:
            return Tile(tile, 0, Gaussians.empty())
        with self._lock:
            held = self._versions.get((layer, tile, version))
        if held is not None:
            return held
        stored = self._store.get(layer, tile, version=version)
        if stored is None:
            return None
        found = Tile(tile, version, self.decoded(stored))
        with self._lock:
            self._versions[layer, tile, version] = found
            if len(self._versions) > REMEMBERED_TILES:
                self._versions.popitem(last=False)
        return found

    def content(self, layer: str, tile: TileId, sha: bytes) -> Gaussians | None:
        """The Gaussians of a tile by content hash; None: the store does not hold them."""
        found = self._remembered(tile, sha)
        if found is not None:
            return found
        stored = self._store.by_sha(layer, tile, sha)
        return None if stored is None else self.decoded(stored)

    def decoded(self, stored: StoredTile) -> Gaussians:
        """The Gaussians of a version that was read.

        Raises:
            SchemaError: they cannot be decoded, or are not what the hash says.
        """
        found = self._remembered(stored.tile, stored.sha)
        return self._remember(stored) if found is None else found

    def tile(self, stored: StoredTile) -> AnyTile:
        """A version that was read, of any layer.

        Raises:
            SchemaError: it cannot be decoded, or is not what the hash says.
        """
        return (
            stored.decode()
            if is_feature_layer(stored.layer)
            else Tile(stored.tile, stored.version, self.decoded(stored))
        )

    def keep(self, tile: Tile) -> None:
        """Remember a tile that was made here: it will be announced, and quoted by the next reports."""
        self._put(tile.tile_id, tile.sha, tile.gaussians)

    def state(self, tile: TileId, journal: TileJournal) -> TileState:
        """What the closed windows of a tile have come to.

        Raises:
            MergerError, CodecError, SchemaError: it cannot be read.
        """
        if journal.memory is not None:
            return decode_state(tile, journal.memory)
        epoch = Gaussians.empty() if journal.epoch is None else self.decoded(journal.epoch)
        return TileState(epoch, TileMemory())

    def _remembered(self, tile: TileId, sha: bytes) -> Gaussians | None:
        with self._lock:
            if (tile, sha) in self._held:
                self._held.move_to_end((tile, sha))
            return self._held.get((tile, sha))

    def _remember(self, stored: StoredTile) -> Gaussians:
        gaussians = stored.decode_gaussians().gaussians
        self._put(stored.tile, stored.sha, gaussians)
        return gaussians

    def _put(self, tile: TileId, sha: bytes, gaussians: Gaussians) -> None:
        with self._lock:
            self._held[tile, sha] = gaussians
            while len(self._held) > REMEMBERED_TILES:
                self._held.popitem(last=False)
