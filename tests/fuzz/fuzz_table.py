"""The tables of docs/fuzzing.md, which a test compares:

python tests/fuzz/fuzz_table.py          # writes them anew from the targets and tests/fuzz/counts.json
python tests/fuzz/fuzz_table.py --add    # adds what lies in build/fuzz/results.jsonl to the counts before, once
"""

import json
import sys
from typing import Final

from fuzz_paths import ROOT, add_paths

add_paths()

PAGE: Final = ROOT / "docs" / "fuzzing.md"
COUNTS: Final = ROOT / "tests" / "fuzz" / "counts.json"
RESULTS: Final = ROOT / "build" / "fuzz" / "results.jsonl"
BEGIN, END = "<!-- targets -->\n", "<!-- end of targets -->\n"
COUNTS_BEGIN, COUNTS_END = "<!-- counts -->\n", "<!-- end of counts -->\n"


def table() -> str:
    """A line a target: name, format, entry points."""
    from fuzz_all import TARGETS

    head = "| target | format | entry points |\n|---|---|---|\n"
    rows = (
        f"| `{one.name}` | {one.form} | {', '.join(f'`{entry}`' for entry in one.reads) or 'as above'} |\n"
        for one in TARGETS.values()
    )
    return head + "".join(rows)


def counts_table() -> str:
    """A line a target: cases guided and seeded, the longest call, findings; empty: not written down."""
    from fuzz_all import TARGETS

    counts = json.loads(COUNTS.read_text(encoding="utf-8"))
    rows = ["| target | cases guided | cases seeded | longest call, s | findings |\n|---|---|---|---|---|\n"]
    for name in TARGETS:
        one = counts.get(name, {})
        longest, found = one.get("longest_s"), one.get("findings")
        said = "" if longest is None else f"{longest:.3f}", "" if found is None else str(found)
        rows.append(f"| `{name}` | {one.get('guided', 0):,} | {one.get('seeded', 0):,} | {said[0]} | {said[1]} |\n")
    every = [counts[name] for name in TARGETS if name in counts]
    guided, seeded = (sum(one[kind] for one in every) for kind in ("guided", "seeded"))
    million = sum(one["guided"] >= 1_000_000 for one in every)
    untried = sum(not counts.get(name, {}).get("guided") for name in TARGETS)
    return "".join(rows) + (
        f"\n{len(TARGETS)} targets, {guided:,} cases guided by coverage and {seeded:,} seeded; a million guided cases"
        f" for {million} targets, none for {untried}.\n"
    )


def add_results() -> None:
    """Add the runs of the results to the counts; the results are put aside, so that none counts twice."""
    if not RESULTS.is_file():
        sys.exit(
            f"{RESULTS} is not there: no run of tests/fuzz/run.py since the last --add. The tables need no runs:"
            " they are written from tests/fuzz/counts.json without --add."
        )
    counts = json.loads(COUNTS.read_text(encoding="utf-8"))
    for line in RESULTS.read_text(encoding="utf-8").splitlines():
        said = json.loads(line)
        empty = {"guided": 0, "seeded": 0, "longest_s": None, "findings": None}
        one = counts.setdefault(said["target"], empty)
        one["guided" if said["engine"] == "atheris" else "seeded"] += said["cases"]
        one["longest_s"] = max(one["longest_s"] or 0.0, said["longest_s"])
        one["findings"] = (one["findings"] or 0) + len(said["findings"])
    rows = (f"{json.dumps(name)}: {json.dumps(one)}" for name, one in sorted(counts.items()))
    COUNTS.write_text("{\n" + ",\n".join(rows) + "\n}\n", encoding="utf-8")
    RESULTS.rename(RESULTS.with_suffix(".added.jsonl"))


def _with(page: str, begin: str, end: str, inner: str) -> str:
    before, rest = page.split(begin)
    return before + begin + inner + end + rest.split(end)[1]


if __name__ == "__main__":
    if "--add" in sys.argv[1:]:
        add_results()
    page = _with(PAGE.read_text(encoding="utf-8"), BEGIN, END, table())
    PAGE.write_text(_with(page, COUNTS_BEGIN, COUNTS_END, counts_table()), encoding="utf-8")
