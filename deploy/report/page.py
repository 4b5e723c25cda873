"""The page of a report: one HTML file, nothing from elsewhere, light and dark, on paper always light."""

import re
from collections.abc import Iterable, Iterator, Sequence
from html import escape
from pathlib import Path
from shlex import quote
from typing import Any, Final

from gnd.deploy.html_page import card_list, document, picture, section, text_table, write_html
from gnd.deploy.live_traffic import size_text
from gnd.deploy.report.figures import against_truth, classes_in_words, health, localisation
from gnd.deploy.report.finished_run import FinishedRun
from gnd.deploy.report.pictures import MapStates, map_pictures, map_states
from gnd.deploy.report.software import software
from gnd.deploy.report.work_list import work_list
from gnd.deploy.summary import summary_lines
from gnd.deploy.traffic_page import traffic_sections
from gnd.fleet_bus.settings_file import SETTINGS_FILE
from gnd.fleet_bus.traffic import fleet_totals

_MOST_TILES: Final = 300
_BACKTICKS: Final = re.compile(r"`([^`]+)`")
_MORE_STYLE: Final = """
figure img{display:block;width:100%;max-width:60rem;height:auto;border-radius:.5rem;background:#fff}
h3{font-size:1rem;margin:1.2rem 0 .1rem}
.change figure img{max-width:46rem}.change figcaption,.maps figcaption{display:none}
.maps figure{margin:0 0 1rem}
ul.said{padding-left:1.2rem}ul.said li{margin:.2rem 0}
ul.warn{margin:.5rem 0;padding:0;list-style:none}
ul.warn li{border-left:.3rem solid #d55e00;background:var(--card);padding:.5rem .8rem;margin:.4rem 0;
border-radius:.3rem;overflow-wrap:anywhere}
pre{background:var(--card);padding:.7rem .8rem;border-radius:.5rem;overflow-x:auto;font-size:.85rem}
nav{margin:1rem 0;line-height:1.9}nav a{color:var(--ink);margin-right:.6rem;white-space:nowrap}
p.key i{border:1px solid var(--soft)}
td.t{white-space:normal;overflow-wrap:anywhere}code{overflow-wrap:anywhere;font-size:.85rem}
@media print{:root{--paper:#fff;--ink:#000;--soft:#444;--rule:#bbb;--card:#f2f4f5;--down:#1f7a4d;--up:#7a4fb0;
--extra:#b9c2c9;--l0:#2a6fbb;--l1:#c8641a;--l2:#a98600;--l3:#8a3ffc;--l4:#007d79;--tile:#1f7a4d;color-scheme:light}
body{font-size:11px}main{max-width:none;padding:0}nav{display:none}
h2,h3{break-after:avoid}.change,figure,tr,.cards{break-inside:avoid}
details::details-content{content-visibility:visible;display:block;height:auto}
.wide{overflow:visible}table{font-size:9px}th,td{white-space:normal;padding-right:.4rem}
pre{white-space:pre-wrap;overflow-wrap:anywhere}pre,code,dd,dt,.note,.key{font-size:9px}}
"""


def report_page(run: FinishedRun, pictures: int = 24) -> str:
    """The report of a run as HTML.

    Args:
        run: what is told.
        pictures: so many of the largest changes have one.
    """
    title = f"Report of {escape(run.name)}"
    states = map_states(run)
    parts = list(_parts(run, states, pictures))
    links = " ".join(f'<a href="#{anchor}">{name}</a>' for anchor, name, _ in parts)
    body = (
        f"<header><h1>{title}</h1><p>{escape(_subtitle(run))}</p></header>",
        _missing(run.missing),
        _cards(run),
        f'<nav aria-label="Parts">{links}</nav>',
        *(f'<div id="{anchor}">{section(name, content)}</div>' for anchor, name, content in parts),
    )
    return document(title, body, _MORE_STYLE)


def write_report(path: Path, run: FinishedRun, pictures: int = 24) -> None:
    """Write the report; an earlier one is replaced at once.

    Raises:
        PageError: the file cannot be written.
    """
    write_html(path, report_page(run, pictures))


def _parts(run: FinishedRun, states: MapStates | None, pictures: int) -> Iterator[tuple[str, str, str]]:
    """Anchor, title and content of each part."""
    yield "summary", "Summary", _summary(run)
    yield "maps", "The map", _maps(states)
    yield "changes", "Changes", work_list(run, states, pictures)
    yield "truth", "Against the truth", against_truth(run)
    yield "localisation", "Localisation", localisation(run)
    yield "health", "Health of vehicles", health(run)
    yield "traffic", "Traffic", _traffic(run)
    yield "versions", "Versions of tiles", _versions(run)
    yield "settings", "Settings", _settings(run)
    yield "again", "Do it again", _again(run)


def _subtitle(run: FinishedRun) -> str:
    drives = run.mark.get("drives")
    count = max(len(run.results), len(run.traffic))
    vehicles = "1 vehicle" if count == 1 else f"{count} vehicles"
    what = "recorded drives" if isinstance(drives, list) and drives else "a simulated street"
    km = sum(one.drive_km for one in run.traffic)
    return f"{vehicles} on {what}, {km:.2f} km; {len(run.tiles)} tiles"


def _missing(lines: Sequence[str]) -> str:
    if not lines:
        return ""
    return f'<ul class="warn">{"".join(f"<li>Missing: {escape(one)}</li>" for one in lines)}</ul>'


def _cards(run: FinishedRun) -> str:
    changed = sum(one.changed_voxels() for one in run.tiles)
    total = fleet_totals(run.traffic)
    wire = total["down_wire_bytes"] + total["up_wire_bytes"]
    items = [
        (f"{sum(count for count in run.versions):,}", f"versions of {len(run.tiles)} tiles"),
        (f"{changed:,}", "voxels differ from the map before"),
        ("–" if run.changes is None else f"{len(run.changes.changes):,}", "changes with two voxels or more"),
        (size_text(wire), "on the wire"),
    ]
    f1 = run.summary.get("f1")
    if isinstance(f1, dict) and isinstance(f1.get("after"), int | float):
        items.insert(0, (f"{f1['before']:.1f} → {f1['after']:.1f} %", "observable voxels: macro F1 before and after"))
    p95 = run.summary.get("localisation_p95")
    if isinstance(p95, dict) and isinstance(p95.get("lateral_m"), int | float):
        along, across = 100 * p95["longitudinal_m"], 100 * p95["lateral_m"]
        items.append((f"{along:.1f} / {across:.1f} cm", "along / across: 95 % of errors of localisation"))
    return card_list(items)


def _summary(run: FinishedRun) -> str:
    if not run.summary:
        return '<p class="note">The run has no summary: it was ended before its end. What follows is of its map.</p>'
    try:
        lines = summary_lines(run.summary)
    except (KeyError, TypeError, ValueError):
        return '<p class="note">The summary of the run is damaged, or of another version of this program.</p>'
    return f'<ul class="said">{"".join(f"<li>{_with_code(line)}</li>" for line in lines)}</ul>'


def _with_code(line: str) -> str:
    """A line as HTML; what stands between backticks is a command or a setting."""
    return _BACKTICKS.sub(r"<code>\1</code>", escape(line))


def _maps(states: MapStates | None) -> str:
    if states is None:
        return '<p class="note">The map has no tiles.</p>'
    key = f"<p>Each ellipsoid is one voxel. {escape('; '.join(classes_in_words()))}.</p>"
    pictures = "".join(picture(png, caption) for caption, png in map_pictures(states))
    return f'{key}<div class="maps">{pictures}</div>'


def _traffic(run: FinishedRun) -> str:
    if not run.traffic:
        return '<p class="note">No vehicle left an account of its traffic.</p>'
    return "".join(
        f"<h3>{title}</h3>{content}" if title else content
        for title, content in traffic_sections(run.traffic, run.links)
    )


def _versions(run: FinishedRun) -> str:
    rows = [_version_row(one, count) for one, count in zip(run.tiles, run.versions, strict=True)]
    rows.sort(key=lambda row: (-int(row[4].replace(",", "")), row[0]))
    header = ("tile", "before", "after", "versions", "changed voxels", "voxels", "bytes", "content (SHA-256)")
    which = "Every tile" if len(rows) <= _MOST_TILES else f"The {_MOST_TILES} tiles with most changes, of {len(rows)}"
    table = text_table(header, rows[:_MOST_TILES])
    return f"<details><summary>{which}</summary>{table}</details>"


def _version_row(one: Any, count: int) -> tuple[str, ...]:
    return (
        one.tile.tile.path,
        "–" if one.base is None else str(one.base.version),
        str(one.tile.version),
        str(count),
        f"{one.changed_voxels():,}",
        f"{len(one.after):,}",
        f"{len(one.tile.body):,}",
        one.tile.sha.hex()[:16],
    )


def _settings(run: FinishedRun) -> str:
    made, now = run.mark.get("software"), software()
    by = made if isinstance(made, dict) else {}
    names = list(dict.fromkeys([*map(str, by), *now]))
    rows = [(name, str(by.get(name, "not told")), now.get(name, "–")) for name in names]
    table = text_table(("software", "of the run", "of this report"), rows, left=3)
    sha = run.summary.get("settings_sha256")
    told = f"<p>SHA-256 of the settings: <code>{escape(str(sha))}</code></p>" if sha else ""
    text = f"<pre>{escape(run.settings)}</pre>" if run.settings else '<p class="note">No settings were kept.</p>'
    return f"{table}{told}<details><summary>All settings ({SETTINGS_FILE})</summary>{text}</details>"


def _again(run: FinishedRun) -> str:
    text = (
        f"<p>{SETTINGS_FILE} of the run's folder holds every setting. A simulated street is the same each time; what "
        "vehicles send depends a little on the timing of the machine.</p>"
    )
    return f"{text}<pre>{escape(chr(10).join(_commands(run)))}</pre>"


def _commands(run: FinishedRun) -> Iterable[str]:
    root = quote(str(run.folder.root))
    words = ["gnd", "lab" if run.mark.get("lab") else "fleet", "--config", f"{root}/{SETTINGS_FILE}"]
    drives, base = run.mark.get("drives"), run.mark.get("map")
    if run.mark.get("groups"):
        words += ["--groups", quote(str(run.mark["groups"]))]
    for drive in drives if isinstance(drives, list) else []:
        words += ["--drives", quote(str(drive))]
    if base:
        words += ["--map", quote(str(base))]
    if run.mark.get("made_up"):
        words += ["--made-up", quote(str(run.mark["made_up"]))]
    if run.mark.get("secure"):
        words.append("--secure")
    return (
        f"{' '.join(words)} --out again",
        "gnd report again",
        f"gnd traffic {root}",
        f"gnd map status {quote(str(run.folder.store))}",
        f"gnd view {root}",
    )
