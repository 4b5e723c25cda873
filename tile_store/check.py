"""Whether a store is whole: every page, every newest tile against its hash, every report; what is damaged is named."""

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import apsw

from gnd.gnd_map.content import decode_content
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.bodies import Bodies, bodies_at, place_of_bodies
from gnd.tile_store.connection import SqlConnection, fetch
from gnd.tile_store.errors import StoreError
from gnd.tile_store.migrations import SCHEMA_VERSION, schema_of
from gnd.tile_store.sqlite_connection import SqliteConnection, as_store_error, open_reader

MOST_PAGES_NAMED: Final = 100

Progress = Callable[[str, int, int], None]
"""Called with a step, what is done of it, and of how much."""


def silent(_step: str, _done: int, _total: int) -> None:
    """No progress is shown."""


@dataclass(frozen=True, slots=True)
class Damage:
    """One thing that is not whole: "file" (a line of SQLite's own check), "tile" or "report"; which, and why."""

    kind: str
    name: str
    why: str


@dataclass(frozen=True, slots=True)
class Checked:
    """What was looked at, and what was found."""

    schema: int
    tiles: int
    reports: int
    damages: tuple[Damage, ...]

    def as_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return asdict(self) | {"is_whole": not self.damages}


def check_store(path: Path, *, all_versions: bool = False, progress: Progress = silent) -> Checked:
    """Read everything that counts and compare it with its hash; nothing is changed.

    Args:
        path: the store; it may be in use.
        all_versions: the older versions of tiles, too.
        progress: is told how far it is.

    Raises:
        StoreUnavailable: it cannot be opened at all.
    """
    connection = open_reader(path)
    try:
        connection.execute("BEGIN")  # as it is at one instant
        schema = schema_of(connection, path)
        damages = _of_file(connection, path)
        progress("pages", 1, 1)
        found = check_rows(connection, path, all_versions=all_versions, progress=progress)
        return Checked(schema, found.tiles, found.reports, (*damages, *found.damages))
    except apsw.Error as error:
        raise as_store_error(error, path) from None
    finally:
        connection.close()


def check_rows(
    connection: SqlConnection, location: Path | str, *, all_versions: bool = False, progress: Progress = silent
) -> Checked:
    """As `check_store`, but only what a connection can read: no pages of a file."""
    path, damages = Path(location), list[Damage]()
    keys, failed = _keys(connection, path, "keys_of_versions" if all_versions else "keys_of_heads")
    damages += failed
    for done, (layer, tile, version, sha) in enumerate(keys, 1):
        damages += _of_tile(connection, path, (layer, tile, version), sha)
        progress("tiles", done, len(keys))
    reports, failed = _keys(connection, path, "keys_of_reports")
    damages += failed
    for done, row in enumerate(reports, 1):
        damages += _of_report(connection, path, row)
        progress("reports", done, len(reports))
    return Checked(SCHEMA_VERSION, len(keys), len(reports), tuple(damages))


def require_whole(path: Path, progress: Progress = silent) -> Checked:
    """As `check_store` of all versions; StoreError that names the first damage."""
    checked = check_store(path, all_versions=True, progress=progress)
    if checked.damages:
        first = checked.damages[0]
        raise StoreError(f"{path}: {len(checked.damages)} damages, first {first.kind} {first.name}: {first.why}")
    return checked


def _of_file(connection: SqliteConnection, path: Path) -> list[Damage]:
    try:
        lines = [line for (line,) in connection.execute(f"PRAGMA integrity_check({MOST_PAGES_NAMED})")]
    except apsw.Error as error:
        return [Damage("file", path.name, str(error))]
    return [Damage("file", path.name, line.replace("\n", " ")) for line in lines if line != "ok"]


def _keys(connection: SqlConnection, path: Path, statement: str) -> tuple[list[Any], list[Damage]]:
    try:
        return fetch(connection, statement), []
    except apsw.Error as error:  # the list itself is damaged
        return [], [Damage("file", path.name, f"{statement.replace('_', ' ')}: {error}")]


def _of_tile(connection: SqlConnection, path: Path, key: tuple[str, int, int], sha: bytes) -> Iterable[Damage]:
    layer, tile, version = key
    name = f"{layer} {TileId(tile).path} version {version}"
    try:
        rows = fetch(connection, "body_of_version", {"layer": layer, "tile": tile, "version": version})
        if not rows:
            return [Damage("tile", name, "the version is missing")]
        ((kept_sha, codec_id, body),) = rows
        if not body:
            body = _bodies_of(connection, path).read(kept_sha, codec_id)
        if decode_content(TileId(tile), version, codec_id, body).sha != kept_sha:
            return [Damage("tile", name, "its content is not what its hash says")]
        return [] if kept_sha == sha else [Damage("tile", name, "its hash is not the one in the index")]
    except (GndError, apsw.Error) as error:
        return [Damage("tile", name, str(as_store_error(error, path)))]


def _bodies_of(connection: SqlConnection, path: Path) -> Bodies:
    """The objects among which bodies lie that are not in the store."""
    place = place_of_bodies(connection)
    if place is None:
        raise StoreError(f"{path}: its body lies among objects, and the store does not say where")
    return _reading(place)


@lru_cache(maxsize=4)
def _reading(place: str) -> Bodies:
    return bodies_at(place, to_write=False)


def _of_report(connection: SqlConnection, path: Path, row: tuple[str, int, str, int]) -> Iterable[Damage]:
    layer, tile, report_id, arrival = row
    name = f"{report_id} on {layer} {TileId(tile).path}"
    try:
        found = fetch(connection, "body_of_report", {"arrival": arrival})
    except apsw.Error as error:
        return [Damage("report", name, str(as_store_error(error, path)))]
    return [] if found else [Damage("report", name, "its row is missing")]
