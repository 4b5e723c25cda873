"""The work list: what has changed since the survey, and what people decide about it."""

import threading
from dataclasses import dataclass
from math import radians
from typing import Any, Final

from gnd.deploy.errors import BadQuestion
from gnd.deploy.map_export.changes import Change, map_changes
from gnd.deploy.serve.page_map import PageMap
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store import judging
from gnd.tile_store.errors import ChangedMeanwhile
from gnd.tile_store.judging import JudgedChange, MapChange
from gnd.tile_store.sqlite_store import SqlStore

MOST_CHANGES: Final = 500
MOST_CHANGED_TILES: Final = 2_000
"""Of a large map the work list names the changes of the tiles that changed last."""
MOST_DECISIONS: Final = 50
TRIES: Final = 3
"""So often a decision is tried where the tiles get new versions meanwhile that leave the change as it is."""
_NS_PER_MS: Final = 1_000_000


@dataclass(frozen=True, slots=True)
class _Listed:
    """The list as it was computed: what a browser gets, and what is meant by each key."""

    told: dict[str, Any]
    meant: dict[str, MapChange]


class WorkList:
    """The changes of a map. May be asked from several threads.

    Args:
        shown: the map.
        writing: the same store, to decide in; None: nobody decides.
    """

    def __init__(self, shown: PageMap, writing: SqlStore | None = None) -> None:
        self._shown, self._writing = shown, writing
        self._lock = threading.Lock()
        self._listed = _Listed({}, {})

    @property
    def is_open(self) -> bool:
        """Whether decisions can be taken at all."""
        return self._writing is not None

    def compute(self) -> dict[str, Any]:
        """The changes since the survey, largest first, each with its place in the map's frame and what was decided.

        Raises:
            MissingExtra: scikit-learn is not installed.
        """
        listed = _compute(self._shown)
        with self._lock:
            self._listed = listed
        return listed.told

    def decide(self, key: str, judgement: str, who: str, why: str) -> None:
        """Do and write down what somebody decides about a change of the list.

        Args:
            key: of the change.
            judgement: "accept", "doubt" or "roll_back".
            who: decides.
            why: for who looks later; only what is accepted needs none.

        Raises:
            BadQuestion: no such judgement, or no reason for it.
            ChangedMeanwhile: the change is not on the list (any more), or its tiles change all the time.
            StoreError: it cannot be done.
        """
        if self._writing is None or judgement not in ("accept", "doubt", "roll_back"):
            raise BadQuestion(f"{judgement[:40]!r} is not accept, doubt or roll_back")
        if not why and judgement != "accept":
            raise BadQuestion("say why, for who looks later")
        for left in reversed(range(TRIES)):
            try:
                _do(self._writing, self._meant(key), judgement, who, why)
                return
            except ChangedMeanwhile:
                if not left:
                    raise
            self.compute()

    def _meant(self, key: str) -> MapChange:
        with self._lock:
            found = self._listed.meant.get(key)
        if found is None:
            raise ChangedMeanwhile(f"change {key[:16]!r} is not on the list any more: look again; nothing was done")
        return found


def _do(store: SqlStore, one: MapChange, judgement: str, who: str, why: str) -> None:
    if judgement == "accept":
        judging.accept(store, one, who, why)
    else:
        judging.take_back(store, one, who, why, doubt=judgement == "doubt")


def _compute(shown: PageMap) -> _Listed:
    columns = shown.heads.columns
    rows = [row for row in columns.created_ns.argsort()[::-1].tolist() if columns.version[row] > 1]
    tiles = [TileId(int(columns.morton[row])) for row in rows[:MOST_CHANGED_TILES]]
    if not tiles:
        return _Listed({"changes": [], "alone": 0, "left_out": 0, "decided": []}, {})
    found = map_changes(shown.store, shown.store, layer=shown.layer, old_at_ns=_surveyed_ns(shown, tiles), only=tiles)
    decided = judging.judged(shown.store, shown.layer, tiles)
    accepted = {one.key: one for one in reversed(decided) if one.judgement == "accepted"}
    meant = {}
    listed = []
    for one in found.changes[:MOST_CHANGES]:
        change = MapChange(shown.layer, one.change, one.parts) if one.parts else None
        key = "" if change is None else change.key
        if change is not None:
            meant[key] = change
        listed.append(_change(shown, one) | {"key": key, "accepted": _decision(accepted.get(key))})
    told = {
        "changes": listed,
        "alone": found.alone,
        "left_out": len(found.changes) - len(listed),
        "decided": [_decision(one) for one in decided[:MOST_DECISIONS]],
    }
    return _Listed(told, meant)


def _surveyed_ns(shown: PageMap, tiles: list[TileId]) -> int:
    """When the last of some tiles was put into the map by a survey; of tiles that vehicles have made nothing counts."""
    first = [shown.store.history(shown.layer, tile)[0] for tile in tiles]
    return max((line.created_ns for line in first if line.kind == "base"), default=0)


def _change(shown: PageMap, one: Change) -> dict[str, Any]:
    at = shown.frame.enu_from_geodetic(radians(one.lat_deg), radians(one.lon_deg), one.height_m)
    parts = [{"tile": part.tile.morton, "before": part.before, "version": part.version} for part in one.parts]
    return one.as_dict() | {"at_m": [round(float(x), 2) for x in at], "parts": parts}


def _decision(one: JudgedChange | None) -> dict[str, Any] | None:
    if one is None:
        return None
    told = {
        "key": one.key,
        "at_ms": one.at_ns // _NS_PER_MS,
        "who": one.who,
        "judgement": one.judgement,
        "why": one.why,
    }
    return told | {"tiles": len(one.tiles)}
