"""The commands of a documents page with what it shows that they print, and whether that is what they print.

A page shows them in blocks of ```console, each command after `$ `. A line `...` stands for lines that the page leaves
out. Words must be the same, in the same order; numbers nearly; durations, which hang on the machine, within a factor.
"""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

import pytest

NUMBER = re.compile(r"(?<![\w.])(-?\d[\d,]*(?:\.\d+)?)( s\b)?")
LEFT_OUT = "..."
SLOWER, OFF_S = 10.0, 3.0
"""Durations may be so many times longer or shorter, and be off by so much besides."""


@dataclass(frozen=True)
class ShownCommand:
    """A command of a page: its line without `$ `, and the lines that the page shows after it."""

    line: str
    shown: tuple[str, ...]

    @property
    def words(self) -> list[str]:
        """As a shell splits it."""
        return shlex.split(self.line, comments=True)


def commands_of(page: Path) -> list[ShownCommand]:
    """The commands of all console blocks of a page, in order."""
    found: list[ShownCommand] = []
    for block in re.findall(r"^```console\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL):
        for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            line, *shown = part.rstrip("\n").split("\n")
            found.append(ShownCommand(line, tuple(shown)))
    return found


def check_printed(command: ShownCommand, printed: str, rel: float = 0.05, off: float = 0.3) -> None:
    """Compare what a command printed with what its page shows; numbers within `rel` or `off`."""
    words, numbers = _taken_apart(printed)
    at = 0
    pieces = _pieces(command.shown)
    for number, piece in enumerate(pieces):
        wanted, values = _taken_apart("\n".join(piece))
        found = at if not number else _place(words, wanted, at)
        assert found is not None, f"$ {command.line}\nnot printed:\n{chr(10).join(piece)}\nprinted:\n{printed}"
        assert words[found : found + len(wanted)] == wanted, f"$ {command.line}\nprinted:\n{printed}"
        count = sum(word.count("#") for word in words[:found])
        for got, value in zip(numbers[count:], values, strict=False):
            _check_number(command, got, value, rel, off, printed)
        at = found + len(wanted)
    if pieces[-1]:
        assert at == len(words), f"$ {command.line}\nmore was printed:\n{printed}"


def _pieces(shown: tuple[str, ...]) -> list[list[str]]:
    """The shown lines between those that are left out; the first and the last piece may be empty."""
    pieces: list[list[str]] = [[]]
    for line in shown:
        if line.strip() == LEFT_OUT:
            pieces.append([])
        else:
            pieces[-1].append(line)
    return pieces


def _taken_apart(text: str) -> tuple[list[str], list[tuple[float, bool]]]:
    """Words with `#` for numbers (lines may be broken elsewhere), and the numbers: value, and whether of seconds."""
    numbers = [(float(value.replace(",", "")), bool(second)) for value, second in NUMBER.findall(text)]
    return re.sub(r"[─━┄]+", "─", NUMBER.sub(r"#\2", text)).split(), numbers


def _place(words: list[str], wanted: list[str], at: int) -> int | None:
    return next((k for k in range(at, len(words) - len(wanted) + 1) if words[k : k + len(wanted)] == wanted), None)


def _check_number(
    command: ShownCommand, got: tuple[float, bool], value: tuple[float, bool], rel: float, off: float, printed: str
) -> None:
    if value[1]:
        near = value[0] / SLOWER - OFF_S <= got[0] <= value[0] * SLOWER + OFF_S
    else:
        near = got[0] == pytest.approx(value[0], rel=rel, abs=off)
    assert near, f"$ {command.line}\n{got[0]} was printed, the page shows {value[0]}:\n{printed}"
