"""What compares pages with what commands print says so when they differ."""

from pathlib import Path

import pytest
from console_pages import ShownCommand, check_printed, commands_of

PAGE = """# A page

```console
$ gnd one --to 'a b'   # a remark
12 tiles in 3 s
...
next: gnd two
$ gnd two
done
```
"""


def command(*shown: str) -> ShownCommand:
    return ShownCommand("gnd one", shown)


def test_a_page_is_taken_apart(tmp_path: Path) -> None:
    (tmp_path / "page.md").write_text(PAGE)
    one, two = commands_of(tmp_path / "page.md")
    assert (one.words, one.shown) == (["gnd", "one", "--to", "a b"], ("12 tiles in 3 s", "...", "next: gnd two"))
    assert (two.words, two.shown) == (["gnd", "two"], ("done",))


@pytest.mark.parametrize(
    "printed", ["12 tiles in 3 s\n", "12 tiles\nin 21 s\n", "12.2 tiles in 0.5 s"], ids=["same", "slow", "near"]
)
def test_what_is_nearly_the_same_passes(printed: str) -> None:
    check_printed(command("12 tiles in 3 s"), printed)


@pytest.mark.parametrize(
    "printed",
    ["15 tiles in 3 s", "12 tiles in 99 s", "12 files in 3 s", "12 tiles in 3 s more", "12 tiles", ""],
    ids=["number", "duration", "word", "more", "less", "nothing"],
)
def test_what_is_not_the_same_is_named(printed: str) -> None:
    with pytest.raises(AssertionError, match="gnd one"):
        check_printed(command("12 tiles in 3 s"), printed)


def test_lines_that_are_left_out_may_be_anything_but_the_others_may_not() -> None:
    shown = command("begin 1", "...", "middle 20", "...", "end 3")
    check_printed(shown, "begin 1\nx 9 y\nmiddle 20\nend 3\n")
    number, missing, more = ("1\nmiddle 30\nend 3", "1\nend 3", "1\nmiddle 20\nend 3\nx")
    for printed in (f"begin {rest}" for rest in (number, missing, more)):
        with pytest.raises(AssertionError):
            check_printed(shown, printed)
    check_printed(command("...", "end 3"), "x 1 2\nend 3")
    check_printed(command("begin 1", "..."), "begin 1\nx 1 2\n")
