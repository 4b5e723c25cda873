"""The statements of each SQL dialect by name, each under a line `-- name: <name>`.

`sqlite.sql` holds all of SQLite's. `postgresql.sql` holds the schema of PostgreSQL and what it says otherwise; the rest
it takes from `sqlite.sql`, but for the schema's steps and what it says of many rows at once (`<name>_each`).
"""

import re
from functools import cache
from importlib.resources import files
from types import MappingProxyType
from typing import Final

MARK: Final = "-- name: "
_OF_SCHEMA: Final = ("schema", "has_schema")
_HINT: Final = re.compile(r" INDEXED BY \w+")
_RESERVED: Final = re.compile(r"(?<![:\w])window(?!\w)")
_COMMENT: Final = re.compile(r"--[^\n]*")


@cache
def statements(dialect: str) -> MappingProxyType[str, str]:
    """The statements of a dialect, "sqlite" or "postgresql", by name."""
    own = _read(dialect)
    if dialect == "sqlite":
        return MappingProxyType(own)
    shared = {
        name: sql
        for name, sql in _read("sqlite").items()
        if not name.startswith(_OF_SCHEMA) and f"{name}_each" not in own
    }
    return MappingProxyType(
        {name: sql if name.startswith("schema") else _adapted(sql) for name, sql in (shared | own).items()}
    )


def _adapted(sql: str) -> str:
    """Without comments and SQLite's hints; `window` is a reserved word elsewhere."""
    return _RESERVED.sub('"window"', _HINT.sub("", _COMMENT.sub("", sql))).strip()


def _read(dialect: str) -> dict[str, str]:
    text = files(__name__).joinpath(f"{dialect}.sql").read_text(encoding="utf-8")
    blocks = (block.partition("\n") for block in text.split(MARK)[1:])
    return {name.strip(): sql.strip() for name, _, sql in blocks}
