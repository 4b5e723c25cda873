"""A quick look at a store: is it there, of this release, and whole as far as a look can tell."""

from collections.abc import Iterator

import apsw

from gnd.deploy.doctor.finding import Finding
from gnd.gnd_map.errors import GndError
from gnd.tile_store.location import StoreLocation, file_of, open_store, shown
from gnd.tile_store.migrations import SCHEMA_VERSION, schema_of
from gnd.tile_store.sqlite_connection import as_store_error, open_reader


def store(location: StoreLocation) -> Iterator[Finding]:
    """Schema and integrity of a store; nothing is changed, and an old one is not brought up to date."""
    what, path = f"store {shown(location)}", file_of(location)
    try:
        if path is None:
            with open_store(location, create=False, read_only=True) as opened:
                counts = opened.counts()
            yield Finding(what, "ok", f"answers: {counts.tiles} tiles, {counts.versions} versions")
            return
        connection = open_reader(path)
        try:
            yield _schema(what, schema_of(connection, path))
            yield _integrity(what, connection)
        except apsw.Error as error:
            raise as_store_error(error, path, to_write=False) from None
        finally:
            connection.close()
    except GndError as error:
        yield Finding(what, "fault", str(error), "name another by --store, or bring back a backup (docs/operations.md)")


def _schema(what: str, schema: int) -> Finding:
    if schema == SCHEMA_VERSION:
        return Finding(what, "ok", f"schema {schema}, that of this release")
    if schema == 0:
        return Finding(what, "fault", "an empty file, not yet a store", "gnd map build -o FILE DRIVE makes one")
    says = f"schema {schema}, this release has {SCHEMA_VERSION}"
    return Finding(
        what, "warning", says, "gnd map backup first: the next program that writes to it brings it up to date"
    )


def _integrity(what: str, connection: apsw.Connection) -> Finding:
    lines = [str(line) for (line,) in connection.execute("PRAGMA quick_check(3)")]
    if lines == ["ok"]:
        tiles = next(iter(connection.execute("SELECT count(*) FROM tile_head")))[0]
        return Finding(what, "ok", f"pages are whole (quick look), {tiles} tiles")
    says = f"damaged: {'; '.join(lines).replace(chr(10), ' ')[:200]}"
    return Finding(what, "fault", says, "gnd map check lists it; bring back a backup (docs/operations.md)")
