"""The statements of each SQL dialect, one file a dialect, each statement under a line `-- name: <name>`."""

from functools import cache
from importlib.resources import files
from types import MappingProxyType
from typing import Final

MARK: Final = "-- name: "


@cache
def statements(dialect: str) -> MappingProxyType[str, str]:
    """The statements of `<dialect>.sql` by name."""
    text = files(__name__).joinpath(f"{dialect}.sql").read_text(encoding="utf-8")
    blocks = text.split(MARK)[1:]
    return MappingProxyType({name.strip(): sql.strip() for name, _, sql in (block.partition("\n") for block in blocks)})
