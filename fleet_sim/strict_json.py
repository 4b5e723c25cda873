"""Values of a JSON file checked against the dataclass that they are meant for, with the place in every complaint."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, fields
from typing import Any, Final

from gnd.fleet_sim.errors import WorldError

MAX_NUMBER: Final = 1e6
"""No coordinate, length or angle of a world is larger."""


def parsed(text: str, where: str) -> object:
    """Return what a JSON text holds.

    Raises:
        WorldError: it is no JSON, or nested too deeply; says where.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise WorldError(f"{where} is not JSON that can be read: it is nested too deeply") from error
    except ValueError as error:
        raise WorldError(f"{where} is not JSON: {error}") from error


def mapping(value: object, where: str) -> dict[str, Any]:
    """Return a JSON object, copied.

    Raises:
        WorldError: it is something else.
    """
    if not isinstance(value, dict):
        raise WorldError(f"{where} must be a JSON object, got {_shown(value)}")
    return dict(value)


def items(value: object, where: str) -> list[Any]:
    """Return a JSON list.

    Raises:
        WorldError: it is something else.
    """
    if not isinstance(value, list):
        raise WorldError(f"{where} must be a list, got {_shown(value)}")
    return value


def arguments(cls: type, data: Mapping[str, Any], where: str, besides: Iterable[str] = ()) -> dict[str, Any]:
    """Return the values for a dataclass's numbers and texts; its fields named in `besides` are the caller's.

    Raises:
        WorldError: a field is missing, unknown, of the wrong type, or a number beyond one million.
    """
    mine = [field for field in fields(cls) if field.name not in set(besides)]
    unknown = sorted(set(data) - {field.name for field in mine})
    missing = [field.name for field in mine if field.default is MISSING and field.name not in data]
    if unknown or missing:
        kinds = (("unknown", unknown), ("missing", missing))
        raise WorldError(f"{where}: " + "; ".join(f"{kind} {', '.join(names)[:200]}" for kind, names in kinds if names))
    for field in mine:
        if field.name in data:
            _check(data[field.name], field.type, f"{where}, {field.name}")
    return dict(data)


def _check(value: object, kind: object, where: str) -> None:
    if kind is float:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= MAX_NUMBER:
            raise WorldError(f"{where} must be a number of at most {MAX_NUMBER:g}, got {_shown(value)}")
    elif kind is int:
        if isinstance(value, bool) or not isinstance(value, int):
            raise WorldError(f"{where} must be a whole number, got {_shown(value)}")
    elif kind is bool:
        if not isinstance(value, bool):
            raise WorldError(f"{where} must be true or false, got {_shown(value)}")
    elif not isinstance(value, str):
        raise WorldError(f"{where} must be a text, got {_shown(value)}")


def _shown(value: object) -> str:
    """A value, shortened; Python refuses to print whole numbers of thousands of digits."""
    if isinstance(value, (dict, list)):
        return type(value).__name__
    if isinstance(value, int) and value.bit_length() > 200:
        return "a huge number"
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
