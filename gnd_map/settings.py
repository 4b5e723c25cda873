"""Settings that a user may turn: declared once with unit, range and effect; read from TOML, environment and options.

A setting is a field of a frozen dataclass, declared with `setting`. Everything that is told about it (messages, the
page of settings, comments in a dump) comes from that declaration. What nobody turns is a constant beside its use.
"""

import dataclasses
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from hashlib import sha256
from typing import Any, Final, Literal, TypeVar, Union, get_args, get_origin

from gnd.gnd_map.bounded import json_value
from gnd.gnd_map.config import from_mapping, to_mapping, type_hints
from gnd.gnd_map.errors import ConfigError

T = TypeVar("T")
_KEY: Final = "setting"
_SEPARATOR: Final = "__"
"""Between the groups of a name in the environment: GND_AGENT__REPORT__LONGEST_S."""


@dataclass(frozen=True, slots=True)
class Setting:
    """What is told about a setting: its effect in a sentence, its unit ("" for none) and its range."""

    effect: str
    unit: str = ""
    least: float | None = None
    most: float | None = None
    above: float | None = None
    below: float | None = None

    @property
    def range(self) -> str:
        """Such as "≥ 0", "> 0 and < 1" or "1 … 64"; "" where there is none."""
        if self.least is not None and self.most is not None:
            return f"{self.least:g} … {self.most:g}"
        bounds = ((">", self.above), ("≥", self.least), ("<", self.below), ("≤", self.most))
        return " and ".join(f"{sign} {bound:g}" for sign, bound in bounds if bound is not None)

    def holds(self, value: float) -> bool:
        """Whether a number is finite and within the range."""
        return (
            _is_finite(value)
            and (self.least is None or value >= self.least)
            and (self.most is None or value <= self.most)
            and (self.above is None or value > self.above)
            and (self.below is None or value < self.below)
        )


def _is_finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number beyond what a double holds
        return False


def setting(
    default: Any,
    effect: str,
    *,
    unit: str = "",
    least: float | None = None,
    most: float | None = None,
    above: float | None = None,
    below: float | None = None,
) -> Any:
    """Declare a field of a frozen dataclass as a setting.

    Args:
        default: its value unless told; a dataclass type makes a group of settings, a mapping is copied; `...`: none,
            it must be given.
        effect: what it does, a sentence.
        unit: of the value, "" for none.
        least: smallest value.
        most: largest value.
        above: larger than this.
        below: smaller than this.
    """
    metadata = {_KEY: Setting(effect, unit, least, most, above, below)}
    if default is ...:
        return field(metadata=metadata)
    if isinstance(default, type):
        return field(default_factory=default, metadata=metadata)
    if isinstance(default, Mapping):
        return field(default_factory=lambda: dict(default), metadata=metadata)
    return field(default=default, metadata=metadata)


def check_settings(config: object, error: type[Exception] = ValueError) -> None:
    """Refuse numbers outside the ranges that a dataclass declares; call it in `__post_init__`.

    Raises:
        error: with name, value and range.
    """
    for each in dataclasses.fields(config):  # type: ignore[arg-type]  # a dataclass value
        told: Setting | None = each.metadata.get(_KEY)
        value = getattr(config, each.name)
        for number in value if isinstance(value, tuple) else (value,):
            if told is None or isinstance(number, bool) or not isinstance(number, int | float):
                continue
            if not told.holds(number):
                raise error(f"{each.name} = {value} lies outside {told.range or 'what is finite'}")


@dataclass(frozen=True, slots=True)
class Described:
    """A row of the page of settings: dotted path, type in words, default as in TOML ("" for none), and the setting."""

    path: str
    kind: str
    default: str
    setting: Setting


def described(cls: type[Any], prefix: str = "", *, default: object = None) -> Iterator[Described]:
    """The settings of a dataclass and its groups, in order.

    Args:
        cls: a dataclass type.
        prefix: path of the group.
        default: a value of `cls` whose fields are the defaults; None: those of the class.
    """
    hints = type_hints(cls)
    for each in dataclasses.fields(cls):
        told: Setting | None = each.metadata.get(_KEY)
        if told is None:
            continue
        path, hint = f"{prefix}.{each.name}" if prefix else each.name, hints[each.name]
        group = _group_of(hint)
        value = getattr(default, each.name) if default is not None else _default_of(each)
        if group is not None and get_origin(hint) is tuple:
            yield Described(path, f"tables of {group.__name__}", "[]", told)
            yield from described(group, f"{path}[]")
        elif group is not None:
            yield from described(group, path, default=value)
        else:
            yield Described(path, _kind(hint), "" if value is dataclasses.MISSING else _toml(value), told)


def known_paths(cls: type[Any]) -> list[str]:
    """Dotted paths of all settings of a dataclass."""
    return [row.path for row in described(cls)]


def merged(*layers: Mapping[str, Any]) -> dict[str, Any]:
    """Nested mappings put over each other; the later one wins, table by table and key by key."""
    found: dict[str, Any] = {}
    for layer in layers:
        for key, value in layer.items():
            below = found.get(key)
            both = isinstance(below, Mapping) and isinstance(value, Mapping)
            found[key] = merged(below, value) if both else value  # type: ignore[arg-type]  # both are mappings
    return found


def of_changes(cls: type[Any], changes: Sequence[str], *, origin: str = "--set") -> dict[str, Any]:
    """What changes such as "report.longest_s=30" say, as a nested mapping.

    Args:
        cls: the dataclass that they change.
        changes: GROUP.FIELD=VALUE; values as in JSON, words without quotes.
        origin: of the changes, for messages.

    Raises:
        ConfigError: no such setting (with near names), or no "=".
    """
    found: dict[str, Any] = {}
    for change in changes:
        path, equals, text = change.partition("=")
        if not equals:
            raise ConfigError(f"{origin} takes NAME=VALUE, such as report.longest_s=30, got {change!r}")
        keys = path.strip().split(".")
        _refuse_unknown_path(cls, keys, origin)
        value: Any = _value(text.strip())
        for key in reversed(keys):
            value = {key: value}
        found = merged(found, value)
    return found


def of_environment(cls: type[Any], prefix: str, environment: Mapping[str, str]) -> dict[str, Any]:
    """What variables such as GND_AGENT__REPORT__LONGEST_S=30 say, as a nested mapping.

    Args:
        cls: the dataclass that they change.
        prefix: "GND_AGENT".
        environment: all variables.

    Raises:
        ConfigError: a variable with this prefix names no setting.
    """
    start = prefix + _SEPARATOR
    names = sorted(name for name in environment if name.startswith(start))
    found: dict[str, Any] = {}
    for name in names:
        path = name[len(start) :].lower().replace(_SEPARATOR, ".")
        found = merged(found, of_changes(cls, [f"{path}={environment[name]}"], origin=name))
    return found


def changed(config: T, changes: Sequence[str], *, origin: str = "--set") -> T:
    """A configuration with settings replaced, each as in `of_changes`.

    Raises:
        ConfigError: no such setting, or a value that it refuses.
    """
    cls = type(config)
    said = of_changes(cls, changes, origin=origin)
    try:
        return from_mapping(cls, merged(to_mapping(config), said))
    except ConfigError as error:
        raise ConfigError(f"{origin} {error}") from error


def from_settings(cls: type[T], mapping: Mapping[str, Any], *, where: str) -> T:
    """As `from_mapping`, but takes settings only, not what a dataclass holds beside them.

    Raises:
        ConfigError: a key is no setting (with near names), or a value is refused.
    """
    for keys in _paths_of(mapping):
        _refuse_unknown_path(cls, keys, where)
    return from_mapping(cls, mapping, where=where)


def plain_settings(config: object) -> dict[str, Any]:
    """The settings of a configuration as plain values: what `from_settings` takes, without None."""
    found: dict[str, Any] = {}
    for each in dataclasses.fields(config):  # type: ignore[arg-type]  # a dataclass value
        value = getattr(config, each.name)
        if _KEY not in each.metadata or value is None:
            continue
        is_group = dataclasses.is_dataclass(value) and _group_of(type(value)) is not None
        is_settings = is_group and any(_KEY in f.metadata for f in dataclasses.fields(value))
        found[each.name] = plain_settings(value) if is_settings else _plain(value)
    return found


def settings_text(config: object) -> str:
    """The effective settings as TOML, with unit and effect beside each: what a file of settings may hold."""
    comments = {row.path: _comment(row.setting) for row in described(type(config))}
    return "".join(f"{line}\n" for line in _tables(plain_settings(config), "", comments))


def settings_sha256(config: object) -> str:
    """SHA-256, in hex, of the effective settings, whatever their comments are."""
    return sha256(json.dumps(plain_settings(config), sort_keys=True).encode()).hexdigest()


def _comment(told: Setting) -> str:
    return ", ".join(part for part in (told.unit, told.range) if part)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {key: item for key, item in to_mapping(value).items() if item is not None}
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return str(value) if hasattr(value, "__fspath__") else value


def _tables(table: Mapping[str, Any], prefix: str, comments: Mapping[str, str]) -> Iterator[str]:
    """Lines of TOML: plain values first, then tables, as the format asks for."""
    plain = {key: value for key, value in table.items() if not _is_table(value)}
    for key, value in plain.items():
        comment = comments.get(f"{prefix}{key}", "")
        yield f"{_bare(key)} = {_toml(value)}" + (f"  # {comment}" if comment else "")
    for key, value in table.items():
        path = f"{prefix}{_bare(key)}"
        if isinstance(value, Mapping):
            yield from ("", f"[{path}]")
            yield from _tables(value, f"{path}.", comments)
        elif key not in plain:
            for item in value:
                yield from ("", f"[[{path}]]")
                yield from _tables(item, f"{path}.", comments)


def _is_table(value: Any) -> bool:
    return isinstance(value, Mapping) or (isinstance(value, list) and bool(value) and isinstance(value[0], Mapping))


def _bare(key: str) -> str:
    simple = key.replace("_", "").replace("-", "")
    return key if simple.isascii() and simple.isalnum() else json.dumps(key, ensure_ascii=False)


def _toml(value: Any) -> str:
    """A plain value as TOML writes it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_bare(key)} = {_toml(item)}" for key, item in value.items()) + "}"
    return "" if value is None else json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")


def _paths_of(mapping: Mapping[str, Any], before: tuple[str, ...] = ()) -> Iterator[list[str]]:
    for key, value in mapping.items():
        if isinstance(value, Mapping) and value:
            yield from _paths_of(value, (*before, str(key)))
        else:
            yield [*before, str(key)]


def _refuse_unknown_path(cls: type[Any], keys: Sequence[str], origin: str) -> None:
    """What lies below a setting that is a table of the user's own keys is not looked at."""
    group: type[Any] | None = cls
    for key in keys:
        if group is None:
            return
        fields = {each.name: each for each in dataclasses.fields(group) if _KEY in each.metadata}
        if key not in fields:
            path, names = ".".join(keys), known_paths(cls)
            near = get_close_matches(path, names, 3, 0.6) or [n for n in names if n.split(".")[-1] == keys[-1]][:3]
            hint = f"did you mean {', '.join(near)}?" if near else f"known here: {', '.join(fields)}"
            raise ConfigError(f"{origin}: there is no setting {path}; {hint}")
        hint_type = type_hints(group)[key]
        group = None if get_origin(hint_type) is tuple else _group_of(hint_type)


def _value(text: str) -> Any:
    try:
        return json_value(text)
    except ValueError:
        return text


def _group_of(hint: Any) -> Any:
    """The dataclass of a group, or of the items of a tuple of groups, if it holds settings."""
    for option in (hint, *(get_args(hint) if get_origin(hint) is tuple else ())):
        is_group = isinstance(option, type) and dataclasses.is_dataclass(option)
        if is_group and any(_KEY in each.metadata for each in dataclasses.fields(option)):
            return option
    return None


def _default_of(each: "dataclasses.Field[Any]") -> Any:
    if each.default_factory is not dataclasses.MISSING:
        return each.default_factory()
    return each.default


def _kind(hint: Any) -> str:
    """A type in words."""
    origin, items = get_origin(hint), get_args(hint)
    if origin is Literal:
        return " or ".join(map(_toml, items))
    if origin is tuple:
        return f"list of {_kind(items[0])}"
    if origin in (dict, Mapping):
        return "table"
    if items and (origin is Union or type(None) in items or origin is not None):
        return " or ".join(_kind(item) for item in items if item is not type(None))
    names = {"str": "text", "float": "number", "int": "whole number", "bool": "true or false", "Path": "path"}
    name = str(getattr(hint, "__name__", hint))
    return names.get(name, "table" if dataclasses.is_dataclass(hint) else name)
