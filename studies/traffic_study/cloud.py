"""The cloud in this process: the store, ingest and merges as in a merger, reached by a call instead of a bus."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.expander import Expander
from gnd.cloud_merger.ingest import Ingest
from gnd.cloud_merger.merge import MergeParameters
from gnd.cloud_merger.states import answer
from gnd.cloud_merger.work import Worker
from gnd.gnd_map.tile import Tile
from gnd.schemas.keys import change_keys, want_key
from gnd.schemas.report_states import ReportState, ReportStates
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import DEFAULT_CODEC, DEFAULT_LAYER, StoreConfig
from studies.simulation.base_map import BaseMap
from studies.traffic_study.errors import TrafficError

_OWNER: Final = "traffic-study"
_LEASE_S: Final = 3600.0
_AT_ONCE: Final = 64
_BETWEEN_NS: Final = 3600 * 1_000_000_000
"""The vehicles that are on the street at a time come an hour after those before them."""


@dataclass(frozen=True, slots=True)
class Message:
    """One request of a vehicle and its answer; or a notice, which has no request."""

    key: str
    request: bytes
    reply: bytes

    @property
    def is_notice(self) -> bool:
        """Whether the cloud began to speak."""
        return not self.request


class Cloud:
    """One merger and its store.

    Args:
        path: of the store; an older one there is removed.
        base: the map that it begins with.
        merge: how statements become changes.
        codec: the lattice of tiles that it makes anew, "float" for none; others stay on that of the base.
    """

    def __init__(self, path: Path, base: BaseMap, merge: MergeParameters, codec: str = DEFAULT_CODEC) -> None:
        for old in path.parent.glob(f"{path.name}*"):
            old.unlink()
        store = StoreConfig(merge_delay_s=0.0)
        config = ShardConfig(_OWNER, path, merge=merge, codec=codec, store=store)
        self._later_ns = 0
        self.store = SqliteStore(path, config.store, now_ns=self._now_ns)
        self.store.put_tiles(Tile(tile, 1, gaussians) for tile, gaussians in base.tiles.items())
        self._ingest = Ingest(self.store, _OWNER, now_ns=self._now_ns)
        self._expander = Expander(self.store, config, self._tell)
        self._worker = Worker(self.store, config)
        self._messages: list[Message] = []
        self._hearers: dict[str, Callable[[str, bytes], None]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.store.close()

    def request(self, key: str, payload: bytes, **_how: object) -> bytes:
        """Answer a vehicle as a merger does; in place of `fleet_bus.Bus.request`."""
        is_report = key.startswith(change_keys().removesuffix("**"))
        reply = self._ingest.answer(key, payload).encode() if is_report else answer(self.store, key, payload)
        self._messages.append(Message(key, payload, reply))
        while self._expander.work():
            pass
        return reply

    def subscribe(self, key: str, callback: Callable[[str, bytes], None], **_how: object) -> None:
        """Tell a vehicle what is wanted of it; in place of `fleet_bus.Bus.subscribe`."""
        self._hearers[key] = callback

    def _tell(self, vehicle: str, state: ReportState) -> None:
        key, notice = want_key(vehicle), ReportStates((state,)).encode()
        self._messages.append(Message(key, b"", notice))
        self._hearers[key](key, notice)

    def heard(self) -> list[Message]:
        """Return the messages since the last call."""
        messages, self._messages = self._messages, []
        return messages

    def _now_ns(self) -> int:
        return time.time_ns() + self._later_ns

    def merge(self) -> int:
        """Merge everything that has been reported; return how many tiles got a new version.

        Raises:
            TrafficError: a tile could not be merged, or a report was refused.
        """
        published = 0
        while claims := self.store.claim(_OWNER, _AT_ONCE, _LEASE_S):
            publications = self._worker.merge(claims)
            if len(publications) != len(claims):
                raise TrafficError(f"{len(claims) - len(publications)} of {len(claims)} tiles could not be merged")
            published += sum(result.status == "published" for result in self.store.publish(publications))
        self._later_ns += _BETWEEN_NS
        bad = self.store.quarantined()
        if bad:
            raise TrafficError(f"{len(bad)} reports were refused, the first: {bad[0].reason}")
        return published

    def map(self) -> BaseMap:
        """Return the newest version of every tile."""
        tiles = {tile.tile_id: tile for tile in self._heads()}
        return BaseMap({i: t.gaussians for i, t in tiles.items()}, {i: t.version for i, t in tiles.items()})

    def _heads(self) -> Iterator[Tile]:
        for entry in self.store.heads(DEFAULT_LAYER):
            stored = self.store.get(DEFAULT_LAYER, entry.tile)
            if stored is not None:
                yield stored.decode_gaussians()
