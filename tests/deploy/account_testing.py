"""Whether all accounts of a run are one: lines of the ledgers added up here, against everything that is shown."""

import csv
import io
import json
from collections import Counter
from pathlib import Path
from typing import Any

from click.testing import CliRunner
from rich.console import Console

from gnd.deploy.live_traffic import LiveLedgers, kinds_table
from gnd.deploy.traffic_cli import traffic as traffic_command

WAYS = ("up", "down")


def added_up(folder: Path) -> tuple[Counter[tuple[str, str, str]], Counter[tuple[str, str]]]:
    """Payload by vehicle, kind and direction, and wire bytes by vehicle and direction, from the plain lines."""
    payload: Counter[tuple[str, str, str]] = Counter()
    wire: Counter[tuple[str, str]] = Counter()
    for file in (folder / "ledger").glob("*.jsonl"):
        last: dict[str, dict[str, Any]] = {}
        for text in file.read_text().splitlines():
            line = json.loads(text)
            if "kind" in line:
                payload[line["agent"], line["kind"], line["direction"]] += line["app_bytes"]
            elif "wire_up" in line:
                last[line["session"]] = line
        for line in last.values():
            for way in WAYS:
                wire[line["agent"], way] += line[f"wire_{way}"]
    return payload, wire


def assert_one_account(folder: Path, traffic: dict[str, Any]) -> None:
    """Summary, page, terminal, JSON and CSV agree with the lines of the ledgers, to the byte."""
    payload, wire = added_up(folder)
    assert traffic["problem"] == ""
    assert traffic["estimated_wire_bytes"] == 0
    for way in WAYS:
        rows = [row for row in traffic["by_kind"] if row["direction"] == way]
        assert traffic[f"{way}_bytes"] == sum(n for (_, _, w), n in payload.items() if w == way)
        assert traffic[f"{way}_wire_bytes"] == sum(n for (_, w), n in wire.items() if w == way)
        assert sum(row["app_bytes"] for row in rows) == traffic[f"{way}_bytes"]
        assert sum(row["wire_bytes"] for row in rows) == traffic[f"{way}_wire_bytes"]
        for vehicle, sizes in traffic["by_vehicle"].items():
            assert sizes[f"{way}_wire_bytes"] == wire[vehicle, way]
            assert sizes[f"{way}_bytes"] == sum(n for (v, _, w), n in payload.items() if (v, w) == (vehicle, way))
    kinds = {(row["kind"], row["direction"]): row["app_bytes"] for row in traffic["by_kind"] if row["messages"]}
    assert all(n == sum(m for (_, k, w), m in payload.items() if (k, w) == key) for key, n in kinds.items())
    _assert_shown(folder, traffic)


def _assert_shown(folder: Path, traffic: dict[str, Any]) -> None:
    up, down = traffic["up_wire_bytes"], traffic["down_wire_bytes"]
    told = json.loads(CliRunner().invoke(traffic_command, [str(folder), "--json"]).stdout)["fleet"]
    assert (told["up_wire_bytes"], told["down_wire_bytes"]) == (up, down)
    assert (told["up_bytes"], told["down_bytes"]) == (traffic["up_bytes"], traffic["down_bytes"])
    assert told["lines"] == traffic["by_kind"]
    table = list(csv.DictReader(io.StringIO(CliRunner().invoke(traffic_command, [str(folder), "--csv"]).stdout)))
    assert sum(int(row["wire_bytes"]) for row in table) == up + down
    page = (folder / "traffic.html").read_text()
    assert f"all bytes on the wire ({up + down:,} B)" in page
    for way in WAYS:
        assert f"<td>{traffic[f'{way}_bytes'] / 1000:,.3f}</td>" in page
        assert f"<td>{traffic[f'{way}_wire_bytes'] / 1000:,.3f}</td>" in page
    live = LiveLedgers(folder)
    live.refresh()
    console = Console(width=100, file=io.StringIO(), record=True)
    console.print(kinds_table(tuple(live.agents.values())))
    last = next(line.split() for line in console.export_text().splitlines() if line.startswith("all "))
    assert (last[1], last[3]) == (f"{down / 1000:.3f}", f"{up / 1000:.3f}")
