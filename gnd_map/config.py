"""Typed configuration: nested frozen dataclasses from a mapping (as read from TOML or JSON) and back.

Defaults run; a key that no field has is an error that names the keys there are, so that a typing error never passes in
silence.
"""

import dataclasses
import enum
import types
from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from gnd.gnd_map.errors import ConfigError

T = TypeVar("T")

_HINTS: Final[dict[type, dict[str, Any]]] = {}


def type_hints(cls: type) -> dict[str, Any]:
    """The types of a class's fields. Their texts are evaluated once: to do it at each call takes longer than to read a
    file of settings.
    """
    if cls not in _HINTS:
        _HINTS[cls] = get_type_hints(cls)
    return _HINTS[cls]


def from_mapping(cls: type[T], mapping: Mapping[str, Any], *, where: str = "") -> T:
    """Build the dataclass `cls` from `mapping`; fields that are missing keep their defaults.

    Nested dataclasses take nested mappings, tuples take lists, floats take ints, enums take their names.

    Args:
        cls: a dataclass type.
        mapping: field names to plain values.
        where: path of `mapping` in the whole configuration, for messages ("agent.bus").

    Raises:
        ConfigError: a key is unknown or missing, a type is wrong, or the dataclass refuses its values.
    """
    if not (isinstance(cls, type) and dataclasses.is_dataclass(cls)):
        raise TypeError(f"{cls!r} is no dataclass")
    if not isinstance(mapping, Mapping):
        raise ConfigError(f"{where or cls.__name__}: expected a table of {cls.__name__}, got {_shown(mapping)}")
    fields = {field.name: field for field in dataclasses.fields(cls) if field.init}
    _refuse_unknown(set(mapping) - set(fields), fields, where or cls.__name__)
    _refuse_missing(fields, mapping, where or cls.__name__)
    hints = type_hints(cls)
    values = {name: _convert(hints[name], value, _join(where, name)) for name, value in mapping.items()}
    try:
        return cast("T", cls(**values))
    except ValueError as error:
        raise ConfigError(f"{where or cls.__name__}: {error}") from error


def to_mapping(config: object) -> dict[str, Any]:
    """The plain values of a dataclass: what `from_mapping` takes; the effective configuration of a run."""
    if not dataclasses.is_dataclass(config) or isinstance(config, type):
        raise TypeError(f"{config!r} is no dataclass value")
    return {field.name: _plain(getattr(config, field.name)) for field in dataclasses.fields(config) if field.init}


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return to_mapping(value)
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return str(value) if hasattr(value, "__fspath__") else value


def _refuse_unknown(unknown: set[str], fields: Mapping[str, Any], where: str) -> None:
    if unknown:
        raise ConfigError(
            f"{where}: unknown key {', '.join(sorted(map(str, unknown)))}; known keys: {', '.join(fields)}"
        )


def _refuse_missing(fields: Mapping[str, "dataclasses.Field[Any]"], mapping: Mapping[str, Any], where: str) -> None:
    needed = [name for name, field in fields.items() if _has_no_default(field) and name not in mapping]
    if needed:
        raise ConfigError(f"{where}: missing key {', '.join(needed)}")


def _has_no_default(field: "dataclasses.Field[Any]") -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _join(where: str, name: str) -> str:
    return f"{where}.{name}" if where else name


def _shown(value: object) -> str:
    return f"{type(value).__name__} {value!r:.80}"


def _convert(hint: Any, value: Any, where: str) -> Any:
    """`value` as the type that `hint` asks for, or ConfigError."""
    origin = get_origin(hint)
    if hint is Any:
        return value
    if origin in (Union, types.UnionType):
        return _convert_union(get_args(hint), value, where)
    if origin is Literal:
        return _convert_literal(get_args(hint), value, where)
    if origin in (tuple, list):
        return _convert_sequence(origin, get_args(hint), value, where)
    if origin in (dict, Mapping):
        return _convert_table(get_args(hint), value, where)
    return _convert_scalar(hint, value, where)


def _convert_union(options: tuple[Any, ...], value: Any, where: str) -> Any:
    if value is None and type(None) in options:
        return None
    options = tuple(option for option in options if option is not type(None))
    if isinstance(value, Mapping):  # the message of the table says more than "none of these types fits"
        for option in options:
            if dataclasses.is_dataclass(option):
                return _convert(option, value, where)
    for option in options:
        try:
            return _convert(option, value, where)
        except ConfigError:
            if len(options) == 1:
                raise
    raise ConfigError(f"{where}: expected one of {', '.join(map(_name, options))}, got {_shown(value)}")


def _convert_literal(options: tuple[Any, ...], value: Any, where: str) -> Any:
    for option in options:
        if value == option and type(value) is type(option):
            return value
    raise ConfigError(f"{where}: expected one of {', '.join(map(repr, options))}, got {_shown(value)}")


def _convert_sequence(kind: Any, items: tuple[Any, ...], value: Any, where: str) -> Any:
    if isinstance(value, str | bytes) or not isinstance(value, Sequence):
        raise ConfigError(f"{where}: expected a list, got {_shown(value)}")
    if kind is list or (len(items) == 2 and items[1] is Ellipsis):
        items = (items[0],) * len(value)
    if len(items) != len(value):
        raise ConfigError(f"{where}: expected {len(items)} items, got {len(value)}")
    return kind(_convert(item, v, f"{where}[{i}]") for i, (item, v) in enumerate(zip(items, value, strict=True)))


def _convert_table(items: tuple[Any, ...], value: Any, where: str) -> Any:
    if not isinstance(value, Mapping):
        raise ConfigError(f"{where}: expected a table, got {_shown(value)}")
    key_hint, value_hint = items
    return {_convert(key_hint, k, where): _convert(value_hint, v, _join(where, str(k))) for k, v in value.items()}


def _convert_scalar(hint: Any, value: Any, where: str) -> Any:
    if isinstance(value, hint) and not (isinstance(value, bool) and hint in (int, float)):
        return value
    if dataclasses.is_dataclass(hint):
        return from_mapping(cast("type[Any]", hint), value, where=where)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            raise ConfigError(f"{where}: a number of {value.bit_length()} bits is too large") from None
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return _convert_enum(hint, value, where)
    if hasattr(hint, "__fspath__") and isinstance(value, str):
        return hint(value)
    raise ConfigError(f"{where}: expected {_name(hint)}, got {_shown(value)}")


def _convert_enum(hint: type[enum.Enum], value: Any, where: str) -> enum.Enum:
    if isinstance(value, str) and value in hint.__members__:
        return hint[value]
    raise ConfigError(f"{where}: expected one of {', '.join(hint.__members__)}, got {_shown(value)}")


def _name(hint: Any) -> str:
    return str(getattr(hint, "__name__", hint))
