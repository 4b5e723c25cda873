"""JSON that somebody else has written: read within limits, taken apart with errors that say where."""

import json
from math import isfinite
from typing import Any, Final, NoReturn

from gnd.tile_store.feature_io.errors import BadElement, NotWellFormed

MAX_JSON_BYTES: Final = 500_000_000


def read_json(data: bytes, where: str) -> Any:
    """The value in the bytes; NotWellFormed when they are no JSON, have NaN, or nest too deep."""
    try:
        return json.loads(data.decode("utf-8-sig"), parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise NotWellFormed(f"{where}: not well-formed JSON: {error or 'too deeply nested'}") from None


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no JSON number")


def member(where: str, value: Any, key: str, kind: type) -> Any:
    """A member of an object, of a type; BadElement otherwise."""
    if not isinstance(value, dict):
        raise BadElement(f"{where}: expected an object, got {type(value).__name__}")
    if key not in value:
        raise BadElement(f"{where}: has no {key}")
    found = value[key]
    if not isinstance(found, kind):
        raise BadElement(f"{where}: {key} is {type(found).__name__}, expected {kind.__name__}")
    return found


def real_number(where: str, value: Any) -> float:
    """A finite number; BadElement otherwise."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not isfinite(value):
        raise BadElement(f"{where}: {value!r:.60} is no number")
    return float(value)


def as_text(value: Any) -> str:
    """A JSON value as the text of an attribute."""
    return value if isinstance(value, str) else json.dumps(value, sort_keys=True, separators=(",", ":"))
