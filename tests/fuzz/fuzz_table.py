"""The table of targets in docs/fuzzing.md: `python tests/fuzz/fuzz_table.py` writes it anew, a test compares."""

import json
from collections import Counter
from typing import Final

from fuzz_paths import ROOT, add_paths

add_paths()

PAGE: Final = ROOT / "docs" / "fuzzing.md"
BEGIN, END = "<!-- targets -->\n", "<!-- end of targets -->\n"


def table() -> str:
    """A line a target: name, format, entry points."""
    from fuzz_all import TARGETS

    head = "| target | format | entry points |\n|---|---|---|\n"
    rows = (
        f"| `{one.name}` | {one.form} | {', '.join(f'`{entry}`' for entry in one.reads) or 'as above'} |\n"
        for one in TARGETS.values()
    )
    return head + "".join(rows)


def results() -> str:
    """A line a target of build/fuzz/results.jsonl, all its runs together."""
    path = ROOT / "build" / "fuzz" / "results.jsonl"
    cases: Counter[str] = Counter()
    for line in path.read_text(encoding="utf-8").splitlines():
        said = json.loads(line)
        cases[said["target"]] += said["cases"]
    return "".join(f"| `{name}` | {n:,} |\n" for name, n in cases.items())


if __name__ == "__main__":
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    PAGE.write_text(before + BEGIN + table() + END + rest.split(END)[1], encoding="utf-8")
    print(results())
