"""One declaration of options: what the command line reads, what is refused, what stands in the help."""

from dataclasses import dataclass
from pathlib import Path

import click
import pytest

from studies.frame.errors import OptionError
from studies.frame.options import Option, check, numbers, of_arguments, option, parts, seeds


def _square(side: int, name: str = "plain") -> str:
    return f"{name} {side * side}"


@dataclass(frozen=True, slots=True)
class Options:
    """Of every kind one."""

    seeds: tuple[int, ...] = seeds(3, 4)
    km: float = option(2.0, "Length.", span=(1, 5))
    name: str = option("plain", "A name.", known=("plain", "fancy"))
    cars: bool = option(True, "Whether cars drive.")
    folder: Path | None = option(None, "Where.")
    square: str = parts(_square, using=("name",), side=(2, Option("Its side.")))
    words: tuple[str, ...] = option((), "As given.", "--set", repeated=True)

    def __post_init__(self) -> None:
        check(self)


def test_without_arguments_the_defaults_hold() -> None:
    assert of_arguments(Options, []) == Options()
    assert Options().square == "plain 4"


def test_every_kind_is_read() -> None:
    words = ["--seeds", "1,5-7", "--world-seed", "9", "--km", "3", "--no-cars", "--folder", "x", "--side", "3"]
    found = of_arguments(Options, [*words, "--name", "fancy", "--set", "a.b=1,2", "--set", "c=3"])
    assert found == Options((1, 5, 6, 7, 9), 3.0, "fancy", False, Path("x"), "fancy 9", ("a.b=1,2", "c=3"))


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--seeds", "5,5"], "--seeds must be different integers >= 0, got 5, 5"),
        (["--seeds", ""], "got none"),
        (["--seeds", "-1"], "got -1"),
        (["--km", "5.5"], "--km must be 1 … 5, got 5.5"),
        (["--name", "odd"], "--name: there is no odd; known are plain, fancy"),
    ],
)
def test_what_cannot_be_is_refused(words: list[str], says: str) -> None:
    with pytest.raises(OptionError, match=says):
        of_arguments(Options, words)


@pytest.mark.parametrize("text", ["one", "5-3", "1,,x", "1-"])
def test_numbers_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(click.BadParameter, match="expected numbers"):
        numbers("--seeds", text)
