"""The steps of the store's schema: an older store takes those that it lacks, all in one transaction, when it is opened.

A step is a number and a named block of SQL; it is run once in a store's life. A new step is added at the end. The
schema that a new store begins with (`schema`, number 1) is never changed.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import apsw

from gnd.tile_store.errors import StoreUnavailable
from gnd.tile_store.sql import statements

APPLICATION_ID: Final = 0x474E4453
"""ASCII "GNDS" in the file's header: this database is a GND store."""

STEPS: Final = (
    (1, "schema"),
    (2, "schema_of_confirmation"),
    (3, "schema_of_surveys"),
    (4, "schema_of_parts"),
    (5, "schema_of_journal"),
    (6, "schema_of_operations"),
    (7, "schema_of_uploads"),
    (8, "schema_of_parameters"),
    (9, "schema_of_new_roads"),
    (10, "schema_of_turns"),
    (11, "schema_of_trust"),
    (12, "schema_of_trials"),
    (13, "schema_of_signatures"),
    (14, "schema_of_owners"),
    (15, "schema_of_standings"),
    (16, "schema_of_bodies"),
    (17, "schema_of_body_checks"),
    (18, "schema_of_districts"),
    (19, "schema_of_catalogs"),
    (20, "schema_of_lists"),
    (21, "schema_of_seen"),
)
SCHEMA_VERSION: Final = STEPS[-1][0]
_TRIGGERS: Final = ("survey_goes", "quarantine_grows", "quarantine_shrinks", "copy_notes_", "moved_away_",
                    "district_guard_")  # fmt: skip
"""Triggers of a store; the last three begin the names of those of a copy and of districts' owners (`copying`)."""


def schema_of(connection: apsw.Connection, path: Path) -> int:
    """The number of a store's schema, 0 of an empty file; both of its marks are read at one instant.

    Raises:
        StoreUnavailable: a database of another program, or a store of a newer release.
    """
    marks: list[Any] = connection.execute(
        "SELECT (SELECT application_id FROM pragma_application_id), (SELECT user_version FROM pragma_user_version),"
        " NOT EXISTS (SELECT 1 FROM sqlite_schema)"
    ).fetchall()
    application_id, version, empty = marks[0]
    if application_id != APPLICATION_ID and not (empty and application_id == 0):
        raise StoreUnavailable(f"{path}: an SQLite database of another program, not a tile store; choose another path")
    if version > SCHEMA_VERSION:
        raise StoreUnavailable(
            f"{path}: store schema {version}, this release reads up to {SCHEMA_VERSION}; use the gnd that wrote it"
        )
    if application_id != APPLICATION_ID:
        return 0
    _check_makeup(connection, path)
    return int(version)


def _check_makeup(connection: apsw.Connection, path: Path) -> None:
    """StoreUnavailable for what no release has made: a view can compute for ever, a trigger write what it likes, and
    tables without types hold anything.
    """
    found: list[Any] = connection.execute(
        "SELECT type, name FROM pragma_table_list WHERE schema = 'main' AND substr(name, 1, 7) <> 'sqlite_'"
        " AND (type <> 'table' OR NOT strict)"
        " UNION ALL SELECT type, name FROM sqlite_schema WHERE type = 'trigger'"
    ).fetchall()
    strange = [(kind, name) for kind, name in found if kind != "trigger" or not name.startswith(_TRIGGERS)]
    if strange:
        kind, name = strange[0]
        raise StoreUnavailable(f"{path}: not a tile store as any release has made one: {kind} {str(name)[:80]!r}")


def migrate(connection: apsw.Connection, path: Path) -> None:
    """Run the steps that the store lacks; on any error it stays as it was."""
    sql = statements("sqlite")
    connection.execute("BEGIN IMMEDIATE")
    try:
        found = schema_of(connection, path)  # another process may have done it since somebody looked
        for number, name in STEPS:
            if number > found and not _is_there(connection, sql, name):
                connection.execute(sql[name])
        connection.pragma("user_version", SCHEMA_VERSION)
        connection.pragma("application_id", APPLICATION_ID)
        connection.execute("COMMIT")
    except BaseException:
        if connection.in_transaction:
            connection.execute("ROLLBACK")
        raise


def _is_there(connection: apsw.Connection, sql: Mapping[str, str], name: str) -> bool:
    """Whether a release before schemas had steps has added it: it looked for tables, and left the number as it was."""
    return f"has_{name}" in sql and bool(connection.execute(sql[f"has_{name}"]).fetchall())
