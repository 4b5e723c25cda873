"""Refresh `costs.json` from what the commands have printed: each number beside its command, machine and date.

gnd reproduce steady-vehicle --length 1000 --parking 0.05 --out runs/steady --json steady.json
python -m studies.scale.room -- python -m studies many-tiles --tiles 1000000 --store many.sqlite --json > many.json
python -m studies.scale.room --with PID -- python -m studies many-tiles --tiles 1000000 --store URL --json > there.json
python -m studies.scale.room --with PID -- python -m studies.stores_study URL --server PID > stores.jsonl
python -m studies.scale.collect --steady runs/steady steady.json --many many.json --many-database there.json
python -m studies.scale.collect --stores stores.jsonl

URL: of a PostgreSQL database of its own, PID: the first process of its server. What is not given stays as it is. A
store with many tiles is filled first, by the same command without a room: that takes minutes.
"""

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import apsw
import click

from studies.scale.plan import MeasuredFigure
from studies.speed.__main__ import machine

STEADY: Final = "gnd reproduce steady-vehicle --length 1000 --parking 0.05"
MANY: Final = "python -m studies.scale.room{} -- python -m studies many-tiles --tiles 1000000 --store {}"
PLACES: Final = {"file": ("", "many.sqlite"), "postgresql": (" --with PID", "postgresql://…/database")}
STORES: Final = "python -m studies.scale.room --with PID -- python -m studies.stores_study postgresql://… --server PID"
OUT: Final = Path(__file__).parent / "costs.json"
FILE: Final = click.Path(path_type=Path, exists=True)


@click.command(help=__doc__)
@click.option("--steady", nargs=2, type=FILE, help="The run, and what it printed.")
@click.option("--many", type=FILE, help="Of a file.")
@click.option("--many-database", type=FILE, help="Of PostgreSQL.")
@click.option("--stores", type=FILE)
def main(steady: tuple[Path, Path] | None, many: Path | None, many_database: Path | None, stores: Path | None) -> None:
    """Write the file beside this module."""
    found = dict[str, dict[str, Any]]()
    if steady is not None:
        run, printed = steady
        found |= of_steady(json.loads(printed.read_text(encoding="utf-8")), run / "run" / "store.sqlite")
    for kind, path in (("file", many), ("postgresql", many_database)):
        if path is not None:
            found |= of_many(json.loads(path.read_text(encoding="utf-8")), kind)
    if stores is not None:
        found |= of_stores([json.loads(line) for line in stores.read_text(encoding="utf-8").splitlines()])
    where = {"machine": machine(), "at": f"{datetime.now(UTC):%Y-%m-%d}"}
    for one in found.values():
        MeasuredFigure(**one | where)  # checks itself
    told = json.loads(OUT.read_text(encoding="utf-8")) | {name: one | where for name, one in found.items()}
    OUT.write_text(json.dumps(told, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def of_steady(told: dict[str, Any], store: Path) -> dict[str, dict[str, Any]]:
    """Of a vehicle that knows its street: what it sends and asks, and what its street and its reports weigh."""
    km, rows = told["km"], told["rows"]
    connection = apsw.Connection(str(store), flags=apsw.SQLITE_OPEN_READONLY)
    ((parts, asked, body_B),) = connection.execute("SELECT SUM(part = 0), SUM(part = 1), SUM(LENGTH(body)) FROM report")
    ((reports,),) = connection.execute("SELECT COUNT(DISTINCT report_id) FROM report")
    ((tiles, tile_B),) = connection.execute("SELECT COUNT(*), SUM(LENGTH(body)) FROM tile_version WHERE kind = 'base'")
    connection.close()
    questions = sum(row["messages"] for row in rows if (row["kind"], row["direction"]) == ("tile", "up"))
    wire = {
        way: sum(row["wire_bytes"] for row in rows if row["direction"] == way and row["kind"] != "update")
        for way in ("up", "down")
    }
    figures = {
        "reports_a_km": (reports / km, "1/km"),
        "tiles_told_a_report": (parts / reports, ""),
        "tiles_asked_a_report": (asked / reports, ""),
        "journal_B_a_report": (body_B / reports, "B"),
        "questions_a_km": (questions / km, "1/km"),
        "up_kB_a_km": (wire["up"] / km / 1e3, "kB/km"),
        "down_kB_a_km": (wire["down"] / km / 1e3, "kB/km"),
        "tiles_a_km": (tiles / km, "1/km"),
        "map_kB_a_km": (tile_B / km / 1e3, "kB/km"),
    }
    return {name: _figure(value, unit or "a report", STEADY) for name, (value, unit) in figures.items()}


def of_many(told: dict[str, Any], kind: str) -> dict[str, dict[str, Any]]:
    """Of a store with a million tiles."""
    by_name = {one["name"]: one for one in told["figures"]}
    on_disk = by_name["on the disk"]
    row_bytes = on_disk["value"] - int(on_disk["detail"].split(" tiles with ")[1].split()[0])
    command = MANY.format(*PLACES[kind])
    found = {f"{kind}: {name}": _figure(one["value"], one["unit"], command) for name, one in by_name.items()}
    return found | {f"{kind}: row_B": _figure(row_bytes, "B", command)}


def of_stores(told: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """CPU of single things, a file beside PostgreSQL."""
    return {
        f"{kind}: {one['what']}": _figure(one[f"{word} ms CPU"], "ms CPU", STORES)
        for one in told
        for kind, word in (("file", "sqlite"), ("postgresql", "postgresql"))
    }


def _figure(value: float, unit: str, command: str) -> dict[str, Any]:
    return {"value": float(f"{value:.4g}"), "unit": unit, "command": command}


if __name__ == "__main__":
    main()
