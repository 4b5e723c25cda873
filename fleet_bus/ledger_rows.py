"""One line of a ledger file as a checked value; what is no ledger line is left out, never guessed."""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

from gnd.fleet_bus.errors import LedgerError, LinkError
from gnd.fleet_bus.ledger import KINDS, LEDGER_VERSION, Direction
from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.wire import WireBytes
from gnd.gnd_map.config import from_mapping
from gnd.gnd_map.errors import ConfigError

_MOST: Final = 1 << 63
_READ_VERSIONS: Final = (2, LEDGER_VERSION)
_WIRE_FIELDS: Final = tuple(field.name for field in fields(WireBytes))
_LINK_FIELDS: Final = frozenset(field.name for field in fields(LinkProfile))


@dataclass(frozen=True, slots=True)
class Row:
    """A line: the head of a session (`link`), a reading of its connections (`wire`), or a message (`kind`)."""

    agent: str
    session: str
    t_ns: int = 0
    drive_ns: int | None = None
    odometer_m: float = 0.0
    direction: Direction = "up"
    kind: str = ""
    app_bytes: int = 0
    tile: str | None = None
    messages: int = 1
    head_bytes: int | None = None
    took_s: float | None = None
    wire: WireBytes | None = None
    link: LinkProfile | None = None

    @property
    def is_head(self) -> bool:
        """Whether this only opens a session."""
        return not self.kind and self.wire is None


def parse_rows(raw: list[bytes], path: Path) -> list[Row]:
    """The rows of a file, without the lines that are none.

    Raises:
        LedgerError: a session was written by a later program.
    """
    return list(_rows(raw, path))


def _rows(raw: list[bytes], path: Path) -> Iterator[Row]:
    for number, line in enumerate(raw, start=1):
        try:
            values = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if not isinstance(values, dict):
            continue
        _check_version(values, f"{path}, line {number}")
        try:
            yield _row(values)
        except (KeyError, TypeError, ValueError, OverflowError, LinkError):
            continue


def _check_version(values: dict[str, Any], where: str) -> None:
    version = values.get("ledger", LEDGER_VERSION)
    if version not in _READ_VERSIONS:
        raise LedgerError(f"{where}: ledger of version {version!r}; this program reads versions 1 to {LEDGER_VERSION}")


def _row(values: dict[str, Any]) -> Row:
    """Raises KeyError, TypeError, ValueError or OverflowError where it is none."""
    agent, session = _text(values["agent"]), _text(values["session"])
    if "ledger" in values:
        return Row(agent, session, link=_link(values["link"]))
    drive_ns = values["drive_ns"]
    return Row(
        agent,
        session,
        t_ns=_whole(values["t_ns"]),
        drive_ns=None if drive_ns is None else _whole(drive_ns),
        odometer_m=_number(values["odometer_m"]),
        **(_wire(values) if "wire_up" in values else _message(values)),
    )


def _wire(values: dict[str, Any]) -> dict[str, Any]:
    counts = {name: _whole(values.get(f"wire_{name}", 0)) for name in _WIRE_FIELDS}
    return {"wire": WireBytes(**counts | {"down": _whole(values["wire_down"])})}


def _message(values: dict[str, Any]) -> dict[str, Any]:
    direction, kind, tile = values["direction"], values["kind"], values["tile"]
    if direction not in ("up", "down") or kind not in KINDS:
        raise ValueError(f"{direction} {kind}")
    head, took = values.get("head_bytes"), values.get("took_s")
    messages = _whole(values.get("messages", 1))
    return {
        "direction": direction,
        "kind": kind,
        "app_bytes": _whole(values["app_bytes"]),
        "tile": None if tile is None else _text(tile),
        "messages": messages,
        "head_bytes": _whole(head) if head is not None else (None if messages else 0),
        "took_s": None if took is None else _number(took),
    }


def _link(values: Any) -> LinkProfile | None:
    """The profile; a field of a later program is left out, a missing rate has no limit."""
    if not isinstance(values, dict):
        return None
    try:
        return from_mapping(LinkProfile, {name: value for name, value in values.items() if name in _LINK_FIELDS})
    except ConfigError as error:
        raise ValueError(str(error)) from error


def _whole(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < _MOST:
        raise ValueError(f"{value!r} is no count")
    return value


def _number(value: Any) -> float:
    number = float(value)
    if not (math.isfinite(number) and number >= 0):
        raise ValueError(f"{value!r} is no measure")
    return number


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is no text")
    return value
