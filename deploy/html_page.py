"""Pages as one HTML file: no script, nothing from elsewhere, readable on a phone, light and dark."""

import base64
import contextlib
import os
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Final

from gnd.deploy.errors import PageError

STYLE: Final = """
:root{--paper:#fcfcfb;--ink:#1b1f24;--soft:#5d6670;--rule:#d9dde1;--card:#f2f4f5;--down:#1f7a4d;--up:#7a4fb0;
--extra:#b9c2c9;--l0:#2a6fbb;--l1:#c8641a;--l2:#a98600;--l3:#8a3ffc;--l4:#007d79;--tile:#1f7a4d}
@media (prefers-color-scheme:dark){:root{--paper:#15181b;--ink:#e7eaec;--soft:#9aa4ad;--rule:#343a40;--card:#1e2327;
--down:#4fc38a;--up:#b492e6;--extra:#4b545c;--l0:#6aaef2;--l1:#f0955a;--l2:#e3c341;--l3:#be95ff;--l4:#3ddbd9;--tile:#4fc38a}}
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);font:16px/1.5 system-ui,sans-serif}
main{max-width:64rem;margin:0 auto;padding:1rem}
h1{font-size:1.5rem;line-height:1.2;margin:.5rem 0 0;overflow-wrap:anywhere}
h2{font-size:1.15rem;margin:2rem 0 .5rem}
header p,.note,figcaption{color:var(--soft);margin:.2rem 0 1rem}
.cards{display:grid;grid-template-columns:repeat(auto-fit,minmax(9.5rem,1fr));gap:.6rem;margin:0;padding:0;list-style:none}
.cards li{background:var(--card);border-radius:.5rem;padding:.7rem .8rem}
.cards b{display:block;font-size:1.25rem;line-height:1.3;font-variant-numeric:tabular-nums}
.cards span{color:var(--soft);font-size:.85rem;display:block;line-height:1.35}
.wide{overflow-x:auto;margin-bottom:.6rem;-webkit-overflow-scrolling:touch}
table{border-collapse:collapse;width:100%;font-size:.9rem;font-variant-numeric:tabular-nums}
th,td{padding:.3rem .6rem .3rem 0;text-align:right;white-space:nowrap;border-bottom:1px solid var(--rule)}
th{color:var(--soft);font-weight:600;vertical-align:bottom}
th.t,td.t{text-align:left}
tr.rest td{color:var(--soft)}
tr.sum td{font-weight:600;border-bottom:2px solid var(--rule)}
td.bar{min-width:8rem;width:25%;padding-right:0}
.bar i{display:block;height:.75rem;float:left}
.bar i.down{background:var(--down)}.bar i.up{background:var(--up)}.bar i.extra{background:var(--extra)}
.key{color:var(--soft);font-size:.85rem}
.key i{display:inline-block;width:.8rem;height:.8rem;vertical-align:-.1rem;margin:0 .25rem 0 .8rem;border-radius:2px}
.key i:first-child{margin-left:0}
.key i.down{background:var(--down)}.key i.up{background:var(--up)}.key i.extra{background:var(--extra)}
.charts{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(20rem,100%),1fr));gap:1rem}
figure{margin:0;min-width:0}
svg{display:block;width:100%;height:auto;max-width:36rem}
svg text{font:13px system-ui,sans-serif;fill:var(--soft)}
svg .grid{stroke:var(--rule);stroke-width:1}
svg .curve{fill:none;stroke-width:1.6;stroke-opacity:.75}
svg .curve.down{stroke:var(--down)}svg .curve.up{stroke:var(--up)}
svg .link{fill:none;stroke-width:2;stroke-dasharray:6 4}
svg .tile{fill:var(--tile);stroke:var(--paper);stroke-width:.6}
svg.map{max-width:26rem}
details{margin:.6rem 0}summary{cursor:pointer;color:var(--soft)}
dt{font-weight:600}dd{margin:0 0 .6rem;color:var(--soft);font-size:.9rem;overflow-wrap:anywhere}
@media (max-width:34rem){table{font-size:.8rem}th,td{padding-right:.45rem}td.bar{min-width:4rem}
th{white-space:normal}h2{margin-top:1.5rem}}
@media print{details{display:block}}
"""
_HEAD: Final = """<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">"""


def document(title: str, body: Iterable[str], more_style: str = "") -> str:
    """A whole page; title, and the pieces of the body one after the other, are HTML already."""
    content = "\n".join(body)
    head = f"{_HEAD}<title>{title}</title><style>{STYLE}{more_style}</style>"
    return f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body><main>\n{content}\n</main></body></html>\n'


def section(title: str, content: str) -> str:
    """A part of a page; without a title it belongs to the part before."""
    head = f"<h2>{title}</h2>\n" if title else ""
    return f"<section>{head}{content}</section>"


def card_list(items: Iterable[tuple[str, str]]) -> str:
    """Large values, each with what it is."""
    return f'<ul class="cards">{"".join(f"<li><b>{value}</b><span>{what}</span></li>" for value, what in items)}</ul>'


def text_table(header: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> str:
    """A table of plain text, which is escaped here; the first `left` columns are words, the others numbers."""
    head = "".join(f"<th{_side(n, left)}>{escape(one)}</th>" for n, one in enumerate(header))
    body = "".join(
        "<tr>" + "".join(f"<td{_side(n, left)}>{escape(one)}</td>" for n, one in enumerate(row)) + "</tr>"
        for row in rows
    )
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _side(column: int, left: int) -> str:
    return " class=t" if column < left else ""


def picture(image: bytes, caption: str) -> str:
    """A PNG within the page; the caption is plain text."""
    data = base64.b64encode(image).decode()
    return (
        f'<figure><img alt="{escape(caption)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def check_writable(path: Path) -> None:
    """Refuse a place that cannot hold a page.

    Raises:
        PageError: it is a folder, or lies in none.
    """
    if path.is_dir():
        raise PageError(f"cannot write the page {path}: that is a folder, name a file in it")
    if not path.parent.is_dir():
        raise PageError(f"cannot write the page {path}: the folder {path.parent} does not exist")


def write_html(path: Path, text: str) -> None:
    """Write a page; an earlier one is replaced at once.

    Raises:
        PageError: the file cannot be written.
    """
    check_writable(path)
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        partial.write_text(text, encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):  # where nothing can be written nothing is left
            partial.unlink()
        raise PageError(f"cannot write the page {path}: {error.strerror}") from error
