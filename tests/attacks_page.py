"""Makes docs/attacks.md from the docstrings of the tests: `python tests/attacks_page.py [--check]`."""

import ast
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "attacks.md"
HEAD = """# Attacks that are tried

Each line is a test that tries the attack against real processes, or real sessions through a real router, and fails when
it succeeds (`pytest tests/attacks`). The page is made from the tests: `python tests/attacks_page.py`. What is defended,
and what is left, is on [security](security.md).

"""


@dataclass(frozen=True, slots=True)
class Attack:
    """One test: the first sentences of its docstring say what is tried and what meets it."""

    part: str
    name: str
    what: str


def attacks() -> Iterator[Attack]:
    """Those of tests/attacks, in the order of files and lines."""
    for path in sorted((ROOT / "tests" / "attacks").glob("test_attacks_*.py")):
        part = path.stem.removeprefix("test_attacks_")
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.FunctionDef) and node.name.startswith("test_attack_"):
                said = " ".join((ast.get_docstring(node) or "").split())
                yield Attack(part, node.name.removeprefix("test_attack_"), said)


def page() -> str:
    """The whole page."""
    found = list(attacks())
    parts: dict[str, list[Attack]] = {}
    for attack in found:
        parts.setdefault(attack.part, []).append(attack)
    lines = [f"{len(found)} tests; some of them try several forms.", ""]
    for part, own in parts.items():
        lines += [
            f"## {part.replace('_', ' ').capitalize()} ({len(own)})",
            "",
            "| attack | what is tried, and what meets it |",
            "|---|---|",
        ]
        lines += [f"| `{one.name}` | {one.what.replace('|', '/')} |" for one in own] + [""]
    return HEAD + "\n".join(lines).rstrip() + "\n"


def main() -> None:
    """Write the page, or say that it is out of date."""
    if "--check" not in sys.argv:
        PAGE.write_text(page())
    elif PAGE.read_text() != page():
        sys.exit("docs/attacks.md is out of date: python tests/attacks_page.py")


if __name__ == "__main__":
    main()
