"""One declaration of a study's options: a frozen dataclass whose fields say their help and what they may be.

    @dataclass(frozen=True, slots=True)
    class Options:
        seeds: tuple[int, ...] = seeds(11)
        km: float = option(20.0, "Length of the road, km.", span=(5, 100))

        def __post_init__(self) -> None:
            check(self)

From it come the command line (`click_options`), the checks (`check`), and what a result says of its parameters.
"""

import dataclasses
import types
import typing
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal, TypeVar, Union

import click

from studies.frame.errors import OptionError

PATH: Final = click.Path(path_type=Path)
SEEDS: Final = ("--seeds", "--seed", "--world-seed")
T = TypeVar("T")


@dataclasses.dataclass(frozen=True, slots=True)
class Option:
    """One option of the command line.

    Attributes:
        text: its help.
        flags: its names; by default the field's.
        span: least and largest number, None for no limit.
        known: names that it may have, each once; empty for any.
        read: makes the value of the text.
        of: type of a part whose default is None.
        some: whether at least one of the names is needed.
        repeated: may be given several times.
    """

    text: str
    flags: tuple[str, ...] = ()
    span: tuple[float | None, float | None] = (None, None)
    known: Collection[str] = ()
    read: Callable[[str], Any] | None = None
    of: type = str
    some: bool = True
    repeated: bool = False


@dataclasses.dataclass(frozen=True, slots=True)
class OptionParts:
    """A value made of several options: `make(**parts)`, to which the values of the fields `using` are given, too."""

    make: Callable[..., Any]
    options: Mapping[str, tuple[Any, Option]]
    using: tuple[str, ...] = ()


def option(default: Any, text: str, *flags: str, **how: Any) -> Any:
    """A field that is an option, with its default and help; `how`: see `Option`."""
    return dataclasses.field(default=default, metadata={"option": Option(text, flags, **how)})


def seeds(*default: int, text: str = "Seeds, such as 1,2,5-9.") -> Any:
    """The field of seeds: `--seeds 1,2,5-9`."""
    return option(default, text, *SEEDS, repeated=True, span=(0, None))


def parts(make: Callable[..., T], using: tuple[str, ...] = (), **options: tuple[Any, Option]) -> Any:
    """A field that is made of several options, each a default and an `Option`; by default of their defaults."""

    def default() -> T:
        return make(**{name: value for name, (value, _) in options.items()})

    return dataclasses.field(default_factory=default, metadata={"option": OptionParts(make, options, using)})


def check(self: Any) -> None:
    """Refuse what an option may not be; for `__post_init__`.

    Raises:
        OptionError: a number out of its span, an unknown name, one twice.
    """
    for name, one in _declared(type(self)):
        if isinstance(one, Option):
            _check(_flags(name, one)[0], one, getattr(self, name))


def _check(flag: str, one: Option, value: Any) -> None:
    many = value if isinstance(value, tuple) else () if value is None else (value,)
    shown = ", ".join(map(str, many)) or "none"
    if flag in SEEDS and (not many or len(set(many)) != len(many) or min(many) < 0):
        raise OptionError(f"{flag} must be different integers >= 0, got {shown}")
    low, high = one.span
    for number in many if (low, high) != (None, None) else ():
        if (low is not None and not number >= low) or (high is not None and not number <= high):
            may = f"at least {low:g}" if high is None else f"{low:g} … {high:g}"
            raise OptionError(f"{flag} must be {may}, got {number:g}")
    if one.known and isinstance(value, tuple | str):
        unknown = [name for name in many if name not in one.known]
        if unknown or len(set(many)) != len(many) or (one.some and not many):
            wrong = f"there is no {', '.join(unknown)}" if unknown else f"each once, got {shown}"
            raise OptionError(f"{flag}: {wrong}; known are {', '.join(one.known)}")


def _declared(cls: type) -> Iterator[tuple[str, Option | OptionParts]]:
    for field in dataclasses.fields(cls):
        if "option" in field.metadata:
            yield field.name, field.metadata["option"]


def _flags(name: str, one: Option) -> tuple[str, ...]:
    return one.flags or (f"--{name.replace('_', '-')}",)


def _single(cls: type) -> Iterator[tuple[str, Any, Any, Option]]:
    """Name, type, default and declaration of every option, those of parts, too."""
    hints = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        one = field.metadata.get("option")
        if isinstance(one, Option):
            yield field.name, hints[field.name], field.default, one
        elif isinstance(one, OptionParts):
            for name, (default, part) in one.options.items():
                yield name, _type_of(default, part), default, part


def _type_of(default: Any, part: Option) -> Any:
    """Type of a part of a value, which has no field of its own."""
    if default is None:
        return part.of
    return tuple[str, ...] if isinstance(default, tuple) else type(default)


def click_options(cls: type) -> list[click.Parameter]:
    """The options of a dataclass for a command."""
    return [_click(*single) for single in _single(cls)]


def _click(name: str, hint: Any, default: Any, one: Option) -> click.Option:
    flags, shown = list(_flags(name, one)), _shown(default)
    kind, required = _kind(hint), default is dataclasses.MISSING
    if kind is bool:
        flags = [f"{flag}/--no-{flag.removeprefix('--')}" for flag in flags]
    if one.repeated:
        return click.Option([*flags, name], multiple=True, help=one.text + (f"  [default: {shown}]" if shown else ""))
    types_of = {int: int, float: float, bool: None, Path: PATH}
    chosen: Any = types_of.get(kind, str)
    if typing.get_origin(kind) is Literal:
        chosen = click.Choice(typing.get_args(kind))
    start = None if required or default is None else default if kind in types_of else shown
    return click.Option(
        [*flags, name], type=chosen, default=start, required=required, show_default=start not in (None, ""),
        help=one.text,
    )  # fmt: skip


def _kind(hint: Any) -> Any:
    """The type without None."""
    if typing.get_origin(hint) in (Union, types.UnionType):
        return next(one for one in typing.get_args(hint) if one is not type(None))
    return hint


def _shown(default: Any) -> str:
    return ",".join(map(str, default)) if isinstance(default, tuple) else str(default)


def of_arguments(cls: type[T], arguments: Sequence[str], **about: str) -> T:
    """The dataclass of a script's command line; `about`: `help`, and `name` of the script."""
    command = click.Command(about.get("name"), params=click_options(cls), help=about.get("help"))
    with command.make_context(command.name, list(arguments)) as context:
        return options_of(cls, context.params)


def options_of(cls: type[T], given: Mapping[str, Any]) -> T:
    """The dataclass of the command line's values.

    Raises:
        click.BadParameter: a value that cannot be read.
        GndError: a value that cannot work.
    """
    read = {name: _read(_flags(name, one)[0], hint, given[name], one) for name, hint, _, one in _single(cls)
            if given[name] is not None and not (one.repeated and not given[name])}  # fmt: skip
    values = {name: read[name] for name, one in _declared(cls) if isinstance(one, Option) and name in read}
    for name, one in _declared(cls):
        if isinstance(one, OptionParts):
            of = {part: read.get(part, default) for part, (default, _) in one.options.items()}
            values[name] = one.make(**of, **{other: read.get(other, values.get(other)) for other in one.using})
    return cls(**values)


def _read(flag: str, hint: Any, value: Any, one: Option) -> Any:
    kind = _kind(hint)
    if one.read is not None:
        return one.read(value)
    if typing.get_origin(kind) is tuple:
        of = typing.get_args(kind)[0]
        if one.repeated and of is str:
            return tuple(value)  # each as it was given
        text = ",".join(value) if isinstance(value, tuple) else value
        return numbers(flag, text) if of is int else list_of(flag, text, of)
    return value


def list_of(flag: str, text: str, of: Callable[[str], T]) -> tuple[T, ...]:
    """Return the values of an option that takes several, with commas between.

    Raises:
        click.BadParameter: one cannot be read.
    """
    try:
        return tuple(of(part.strip()) for part in text.split(",") if part.strip())
    except ValueError as error:
        raise click.BadParameter(f"expected numbers with commas between, got {text!r}", param_hint=flag) from error


def numbers(flag: str, text: str) -> tuple[int, ...]:
    """Return numbers and ranges, such as 7,1000-1049.

    Raises:
        click.BadParameter: one cannot be read, or a range runs backwards.
    """
    return tuple(number for span in list_of(flag, text, _span) for number in span)


def _span(text: str) -> range:
    first, dash, last = text.partition("-") if not text.startswith("-") else (text, "", "")
    span = range(int(first), int(last if dash else first) + 1)
    if not span:
        raise ValueError(f"{text} runs backwards")
    return span
