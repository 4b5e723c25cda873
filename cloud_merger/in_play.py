"""What counts of each tile, kept between uploads: state, memory and votes; only what came since is read."""

from collections import OrderedDict
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from threading import Lock
from typing import Final

from gnd.cloud_merger.parameters import MergeParameters
from gnd.cloud_merger.statements import Report
from gnd.cloud_merger.stored import Bases, report_of
from gnd.cloud_merger.votes import TileVotes
from gnd.cloud_merger.window import TileState
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import SchemaError
from gnd.tile_store.store import Store
from gnd.tile_store.values import JournalMark, ReportRow, TileJournal

REMEMBERED_TILES: Final = 256  # some 400 kB each where a window is full


@dataclass(frozen=True, slots=True)
class TileInPlay:
    """What counts of a tile since its epoch.

    Attributes:
        mark: how far its journal was read; None: not to its end.
        state: what the closed windows have come to.
        votes: of the reports of the others.
    """

    mark: JournalMark | None
    state: TileState
    votes: TileVotes


class TilesInPlay:
    """The tiles that vehicles reported about last, laid out for `wants`. Safe in several threads.

    It answers what to ask vehicles for, never what the map is: a report that somebody takes out of the journal counts
    here until the tile's next window.

    Args:
        store: of the journal.
        merge: how statements will be merged.
        bases: versions of tiles.
    """

    def __init__(self, store: Store, merge: MergeParameters, bases: Bases) -> None:
        self._store, self._merge, self._bases = store, merge, bases
        self._lock = Lock()
        self._held: OrderedDict[tuple[str, TileId], TileInPlay] = OrderedDict()  # newest last

    def of(self, layer: str, tile: TileId) -> TileInPlay:
        """What counts of a tile now.

        Raises:
            MergerError, CodecError, SchemaError: the state of its closed windows cannot be read.
        """
        with self._lock:
            held = self._held.get((layer, tile))
        found = None if held is None else self._brought_up(layer, tile, held)
        if found is None:
            journal = self._store.in_play(layer, tile)
            votes = TileVotes.of(self._reports(journal.reports))
            found = TileInPlay(journal.mark, self._state(tile, journal), votes)
        with self._lock:
            self._held[layer, tile] = found
            self._held.move_to_end((layer, tile))
            while len(self._held) > REMEMBERED_TILES:
                self._held.popitem(last=False)
        return found

    def _brought_up(self, layer: str, tile: TileId, held: TileInPlay) -> TileInPlay | None:
        since = self._store.in_play_since(layer, tile, held.mark) if held.mark is not None else None
        if since is None:
            return None
        mark, rows = since
        return TileInPlay(mark, held.state, held.votes.with_reports(self._reports(rows)))

    def _state(self, tile: TileId, journal: TileJournal) -> TileState:
        state = self._bases.state(tile, journal)
        return state if self._merge.together else TileState(state.gaussians, state.memory.without_met())

    def _reports(self, rows: Iterable[ReportRow]) -> list[Report]:
        """What stored reports say; not those that can no longer be read, of which the merge will tell."""
        found = []
        for row in rows:
            with suppress(SchemaError):
                found.append(report_of(row.body, self._merge))
        return found
