"""A ROS 2 bag: its topics, its messages in order, and single messages again by where they lie.

`rosbags` reads the containers (MCAP, SQLite, split, compressed) and decodes every type; types that a bag does not
describe are those of ROS 2 Humble.
"""

import contextlib
import weakref
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.files import files_below
from gnd.vehicle_agent.importers.optional import library
from gnd.vehicle_agent.importers.ros.bounds import bound_rosbags

ENDINGS: Final = (".mcap", ".db3")
EXTRA: Final = "ros"


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a bag."""

    name: str
    kind: str
    count: int


@dataclass(frozen=True, slots=True)
class BagMessage:
    """A message as recorded: its bytes, and where it lies: file, log time, how many of the topic with this log time
    come before it.
    """

    topic: str
    file: int
    log_ns: int
    nth: int
    data: bytes


class Bag:
    """An opened bag; its files are closed when it is no longer used.

    notes: files of it that could not be read, a sentence each.

    Raises:
        ImportDriveError: no bag there, or none of its files can be read.
        MissingExtra: `rosbags` is not installed.
    """

    def __init__(self, place: Path, *, strict: bool = False) -> None:
        self.place = place
        self._rosbag2 = library("rosbags.rosbag2", EXTRA)
        self._typesys = library("rosbags.typesys", EXTRA)
        bound_rosbags(EXTRA)
        self.notes: tuple[str, ...] = ()
        self._stack = contextlib.ExitStack()
        weakref.finalize(self, self._stack.close)
        self._readers = self._opened(strict)
        self._store = self._types()

    def _opened(self, strict: bool) -> list[Any]:
        """A reader for the bag as its metadata describes it, else one for each of its files."""
        notes, readers = [], []
        whole = [self.place] if (self.place / "metadata.yaml").is_file() else []
        files = [self.place] if self.place.is_file() else files_below(self.place, *ENDINGS)
        for path in (*whole, *files):
            reader, reason = self._reader(path)
            if reader is not None:
                readers.append(reader)
            else:
                notes.append(f"passed over: {path.name}: {reason}")
            if reader is not None and path in whole:
                break
        if notes and (strict or not readers):
            hint = "; a damaged MCAP: `mcap recover`; a damaged SQLite: `sqlite3 FILE .recover`"
            raise ImportDriveError(f"{self.place}: no readable bag: {'; '.join(notes)}{hint}")
        if not readers:
            raise ImportDriveError(f"{self.place}: no .mcap or .db3 file there")
        self.notes = tuple(notes)
        return readers

    def _reader(self, path: Path) -> tuple[Any, str]:
        """An open reader, or why there is none."""
        try:
            reader = self._rosbag2.Reader(path)
            self._stack.enter_context(reader)
        except Exception as error:
            return None, " ".join(str(error).split())[:200] or type(error).__name__
        return reader, ""

    def _types(self) -> Any:
        typesys = self._typesys
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        for connection in (one for reader in self._readers for one in reader.connections):
            described = connection.msgdef
            if connection.msgtype in store.fielddefs or described.format.name != "MSG":
                continue
            with contextlib.suppress(typesys.TypesysError):
                found = typesys.get_types_from_msg(described.data, connection.msgtype)
                store.register({name: fields for name, fields in found.items() if name not in store.fielddefs})
        return store

    @property
    def topics(self) -> tuple[Topic, ...]:
        """All of its topics, by name."""
        counts: dict[tuple[str, str], int] = {}
        for reader in self._readers:
            for one in reader.connections:
                counts[one.topic, one.msgtype] = counts.get((one.topic, one.msgtype), 0) + one.msgcount
        return tuple(Topic(name, kind, n) for (name, kind), n in sorted(counts.items()))

    def messages(self, topics: Sequence[str]) -> Iterator[BagMessage]:
        """The messages of some topics, file by file, in the order of their log times.

        Raises:
            ImportDriveError: the bag is damaged there.
        """
        for number, reader in enumerate(self._readers):
            chosen = [one for one in reader.connections if one.topic in topics]
            last: dict[str, tuple[int, int]] = {}
            if not chosen:
                continue
            with self._named():
                for connection, log_ns, data in reader.messages(chosen):
                    before = last.get(connection.topic, (-1, -1))
                    nth = before[1] + 1 if before[0] == log_ns else 0
                    last[connection.topic] = log_ns, nth
                    yield BagMessage(connection.topic, number, int(log_ns), nth, bytes(data))

    def again(self, topic: str, file: int, log_ns: int, nth: int) -> bytes:
        """The bytes of a message that was met before."""
        reader = self._readers[file]
        chosen = [one for one in reader.connections if one.topic == topic]
        with self._named():
            for k, (_, _, data) in enumerate(reader.messages(chosen, start=log_ns, stop=log_ns + 1)):
                if k == nth:
                    return bytes(data)
        raise ImportDriveError(f"{self.place}: message {nth} of {topic} at {log_ns} ns is gone")

    def decode(self, data: bytes, kind: str) -> Any:
        """A message of a type by its name; ImportDriveError where bytes are none."""
        with self._named():
            return self._store.deserialize_cdr(data, kind)

    @contextlib.contextmanager
    def _named(self) -> Iterator[None]:
        try:
            yield
        except ImportDriveError:
            raise
        except Exception as error:
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            raise ImportDriveError(f"{self.place}: damaged: {reason}") from error
