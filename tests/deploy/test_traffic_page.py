"""The traffic page: complete without anything from elsewhere, honest figures, in a real browser where there is one."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from html_reader import Reader

from gnd.deploy.errors import PageError
from gnd.deploy.traffic_page import page, write_page
from gnd.deploy.traffic_page_chart import Axes, apart, curves, time_ticks
from gnd.fleet_bus.ledger import Ledger
from gnd.fleet_bus.ledger_file import read_ledger
from gnd.fleet_bus.links import LinkProfile, load_link
from gnd.fleet_bus.traffic import AgentTraffic, agent_traffic
from gnd.fleet_bus.wire import WireBytes
from gnd.gnd_map.tile_id import TileId

TILES = [TileId.from_path(f"13033/03021/23031/2210{digit}") for digit in range(4)]
LINKS = tuple(load_link(name) for name in ("3g", "4g", "5g"))


def account(folder: Path, name: str = "car-1", links=LINKS, *, driven: bool = True) -> AgentTraffic:
    """2 km in 100 s: four tiles at the start, a report at the end."""
    ledger = Ledger(name)
    ledger.begin(load_link("4g"))
    ledger.set_position(0.0, 10**18)
    for number, tile in enumerate(TILES):
        ledger.record("down", "tile", 1000 * (number + 1), tile, head_bytes=80, took_s=0.1 * (number + 1))
    if driven:
        ledger.set_position(2000.0, 10**18 + 100 * 10**9)
    ledger.record("up", "change", 3000, head_bytes=60)
    ledger.record_wire(WireBytes(4000, 11_500, 1, 104, 208, 0, 1448, 52))
    file = folder / f"{len(list(folder.iterdir()))}.jsonl"
    ledger.write_jsonl(file)
    return agent_traffic(read_ledger(file), links)


def test_the_page_holds_the_figures_of_the_account(tmp_path):
    agents = (account(tmp_path), account(tmp_path, "car-2"))
    read = Reader(page("monday", agents, LINKS))
    assert "Traffic of monday" in read.words
    assert "2 vehicles on 4g links, 4.00 km" in read.words
    # 20 kB payload down and 6 kB up over 4 km; 31 kB on the wire of which 26 are payload.
    for figure in ("5.00 kB/km", "1.50 kB/km", "23.0 kB", "8.0 kB", "16.1 %"):
        assert figure in read.words, figure
    for word in (
        "tile",
        "change",
        "TCP acks",
        "session",
        "3g",
        "690.47",
        "Ministry of Science",
        "car-2 by kind and link",
        "Jitter: assumed",
        "0.250",
    ):
        assert word in read.words, word
    assert f"{TILES[3].path} 8.0 8.6 0.0 {TILES[2].path}" in read.words, "two tiles of 4 kB come first"
    # 11.5 kB in 100 s of 5.1 Mbit/s, 4 kB of 1.9 Mbit/s.
    assert "3g 0.018 % 0.0168 %" in read.words
    assert read.count("rect") == len(TILES), "a square a tile"
    assert read.count("svg") == 3


def test_the_rows_of_a_direction_add_up_to_its_sum(tmp_path):
    text = page("r", (account(tmp_path),), LINKS)
    table = text[text.index("By kind of message") : text.index("Along the drive")]
    rows = [re.findall(r"<td[^>]*>([^<]*)</td>", row) for row in re.findall(r"<tr.*?</tr>", table)]
    for way, total in (("down", 11.5), ("up", 4.0)):
        wires = [float(row[5]) for row in rows if len(row) > 5 and row[1] == way and row[0] != "all"]
        assert len(wires) >= 2
        assert sum(wires) == pytest.approx(total, abs=0.05 * len(wires))
        assert [float(row[5]) for row in rows if row[:2] == ["all", way]] == [total]


def test_nothing_comes_from_elsewhere_and_nothing_runs(tmp_path):
    text = page("r", (account(tmp_path),), LINKS)
    read = Reader(text)
    assert not {"script", "link", "img", "iframe", "object", "embed", "use", "image"} & {tag for tag, _ in read.tags}
    for tag, attributes in read.tags:
        assert not {"src", "href", "xlink:href", "srcset", "action"} & set(attributes), tag
        assert not any(name.startswith("on") for name in attributes), tag
    assert "@import" not in text
    assert "url(" not in text
    viewports = [attributes for tag, attributes in read.tags if attributes.get("name") == "viewport"]
    assert viewports[0]["content"] == "width=device-width, initial-scale=1"
    assert "prefers-color-scheme:dark" in text


def test_names_from_files_cannot_become_markup(tmp_path):
    evil = '<script>alert("x")</script>&amp;'
    link = LinkProfile('a"><b>', 1e6, 1e6, rate_source="<img src=x>")
    ledger = Ledger(evil)
    ledger.record("down", "tile", 100, '"/><script>')
    ledger.write_jsonl(tmp_path / "e.jsonl")
    agent = agent_traffic(read_ledger(tmp_path / "e.jsonl"), (link,))
    read = Reader(page(evil, (agent,), (link,)))
    assert {"script", "img"} & {tag for tag, _ in read.tags} == set()
    assert f"Traffic of {evil}" in read.words


def test_a_run_in_which_nothing_happened_has_a_page(tmp_path):
    ledger = Ledger("idle")
    ledger.begin(load_link("none"))
    ledger.write_jsonl(tmp_path / "idle.jsonl")
    agent = agent_traffic(read_ledger(tmp_path / "idle.jsonl"), LINKS)
    read = Reader(page("idle", (agent,), LINKS))
    assert "No message of this run was about a tile" in read.words


def test_an_agent_that_stands_still_has_no_rates(tmp_path):
    agent = account(tmp_path, driven=False)
    read = Reader(page("parked", (agent,), LINKS))
    assert "10.0 kB down, payload" in read.words
    assert "kB/km down, payload" not in read.words


def test_links_without_limits_have_no_line(tmp_path):
    free = load_link("none")
    agent = account(tmp_path, links=(free,))
    assert 'class="link"' not in curves((agent,), (free,), "down")
    assert "no limit" in Reader(page("r", (agent,), (free,))).words
    assert curves((agent,), LINKS, "down").count('class="link"') == 3


def test_the_scale_is_logarithmic_and_ends_are_ends():
    axes = Axes(100.0, 2, 6)
    assert axes.x(0.0) < axes.x(50.0) < axes.x(100.0) == axes.x(1000.0)
    assert axes.y(1e3) - axes.y(1e4) == pytest.approx(axes.y(1e4) - axes.y(1e5))
    assert axes.y(0) == axes.y(100)


def test_a_curve_ends_at_the_total_and_a_link_at_its_capacity(tmp_path):
    agent = account(tmp_path)
    svg = curves((agent,), LINKS[:1], "down")
    axes = Axes(100.0, 2, 8)  # 10 kB / 100, and 5.1 Mbit/s for 100 s = 64 MB
    curve = re.search(r'class="curve down" d="([^"]*)"', svg)
    assert curve is not None
    assert re.findall(r"V([\d.]+)", curve[1])[-1] == f"{axes.y(10_000):.1f}"
    link = re.search(r'class="link"[^>]* d="M([^"]*)"', svg)
    assert link is not None
    assert link[1].split("L")[-1] == f"{axes.x(100.0):.1f} {axes.y(5.1e6 / 8 * 100):.1f}"


@pytest.mark.parametrize(
    ("end_s", "expected"),
    [
        (100, [0, 20, 40, 60, 80, 100]),
        (23.1, [0, 5, 10, 15, 20]),
        (0.9, [0, 0.2, 0.4, 0.6, 0.8]),
        (3600, [0, 1000, 2000, 3000]),
    ],
)
def test_times_on_the_axis_are_round(end_s, expected):
    assert time_ticks(end_s) == pytest.approx(expected)


def test_labels_keep_apart_in_their_order():
    assert apart([10.0, 12.0, 100.0], 15.0) == [-3.0, 12.0, 100.0]
    assert apart([], 15.0) == []


def test_a_page_replaces_an_earlier_one_and_leaves_nothing_else(tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "t.html").write_text("old")
    write_page(folder / "t.html", "r", (account(tmp_path),), LINKS)
    assert (folder / "t.html").read_text().startswith("<!doctype html>")
    assert [entry.name for entry in folder.iterdir()] == ["t.html"]


@pytest.mark.parametrize("place", ["absent/t.html", "file/t.html", "folder"])
def test_a_page_that_cannot_be_written_is_an_error_that_names_it(tmp_path, place):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    with pytest.raises(PageError, match=rf"cannot write the page .*{place}: "):
        write_page(tmp_path / place, "r", (account(tmp_path / "folder"),), LINKS)
    assert not list(tmp_path.glob("*.partial"))


MEASURE = """<script>
document.title = [document.documentElement.scrollWidth, innerWidth,
  getComputedStyle(document.body).backgroundColor,
  ...[...document.querySelectorAll('svg')].map(s => Math.round(s.getBoundingClientRect().width))].join(' ');
</script>"""


@pytest.mark.parametrize("width", [390, 1200])
def test_a_browser_shows_it_without_scrolling_sideways(tmp_path, width):
    """On a phone and on a desk. The script that measures is the test's own."""
    browser = shutil.which("chromium") or shutil.which("google-chrome") or shutil.which("chromium-browser")
    if browser is None:
        pytest.skip("no Chromium on this system")
    agents = tuple(account(tmp_path, f"vehicle-{number:02d}") for number in range(12))
    (tmp_path / "t.html").write_text(page("a run with a rather long name of its own " * 3, agents, LINKS) + MEASURE)
    # A window has a least width of its own, so the page stands in a frame.
    frame = f'<body style="margin:0"><iframe src="t.html" style="border:0;width:{width}px;height:3000px"></iframe>'
    wait = "<script>onload = () => {document.title = frames[0].document.title}</script>"
    (tmp_path / "frame.html").write_text(f"<!doctype html><title></title>{frame}{wait}")
    done = subprocess.run(
        [browser, "--headless", "--no-sandbox", "--disable-gpu", "--allow-file-access-from-files",
         f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", (tmp_path / "frame.html").as_uri()],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    found = re.search(r"<title>(\d+) (\d+) (rgb[^)]*\)) ([\d ]+)</title>", done.stdout)
    assert found is not None, done.stderr[-2000:]
    assert int(found[1]) <= int(found[2]) == width
    assert all(200 <= int(size) <= width for size in found[4].split())
