"""`gnd report`: a real run as one page, with and without truth, with parts missing, with hostile names, and as PDF."""

import base64
import json
import re
import shutil
import struct
import subprocess
import zlib
from math import radians
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from fleet_testing import SEED
from html_reader import Reader

from gnd.deploy.errors import PageError, ReportError
from gnd.deploy.live_traffic import size_text
from gnd.deploy.report import printing
from gnd.deploy.report.command import report
from gnd.deploy.report.figures import health_shares
from gnd.deploy.report.finished_run import read_finished_run
from gnd.deploy.report.page import report_page
from gnd.deploy.status.command import status
from gnd.fleet_sim.dense_scan import ScanPlan
from gnd.fleet_sim.errors import TruthError
from gnd.fleet_sim.street import street
from gnd.fleet_sim.truth import make_truth, write_truth
from gnd.gnd_map.classes import ChangeClass
from gnd.picture_style import SAFE_COLOURS

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("fleets"), pytest.mark.timeout(1200)]
EVIL = "<img src=x onerror=alert(1)>&\"'"


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The truth of the street that was driven, scanned coarsely."""
    path = tmp_path_factory.mktemp("truth") / "truth.npz"
    write_truth(make_truth(street(SEED), plan=ScanPlan(spacing_m=6.0, step_rad=radians(1.0))), path)
    return path


@pytest.fixture
def copy(finished_run: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(finished_run, tmp_path / "run"))


def invoke(*arguments: object) -> str:
    result = CliRunner().invoke(report, [str(argument) for argument in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def pictures_of(text: str) -> list[bytes]:
    return [base64.b64decode(data) for data in re.findall(r'src="data:image/png;base64,([^"]+)"', text)]


def test_a_run_of_recorded_drives_is_told_without_truth(finished_run: Path) -> None:
    run = read_finished_run(finished_run)
    text = report_page(run, pictures=3)
    words = Reader(text).words
    summary = json.loads((finished_run / "summary.json").read_text())
    assert run.missing == ()
    assert run.truth is None
    assert "There is no truth" in words
    assert "2 vehicles on recorded drives" in words
    assert f"{summary['reports_sent']} reports sent, {summary['reports_acknowledged']} acknowledged" in words
    assert f"{summary['changed_voxels']:,} voxels differ from the map before" in words
    for part in ("The map", "Changes", "Localisation", "Health", "Traffic", "Versions", "Settings", "Do it again"):
        assert part in words
    assert "vehicle-00" in words
    assert "3g" in words
    assert summary["settings_sha256"] in words
    assert f"--map {run.mark['map']} --out again" in words
    assert run.mark["software"]["eclipse-zenoh"] in words
    # two states of the map, three changes, errors of localisation
    assert len(pictures_of(text)) == 2 + 3 + 1


def test_what_is_a_command_in_the_summary_looks_like_one(copy: Path) -> None:
    waiting = json.loads((copy / "summary.json").read_text())
    waiting["waiting_for_confirmation"] |= {"voxels": 1, "tiles": 1, "parked": 2}
    (copy / "summary.json").write_text(json.dumps(waiting))
    text = report_page(read_finished_run(copy), pictures=0)
    said = text[text.index('<ul class="said">') :].partition("</ul>")[0]
    assert "waiting for confirmation: 1 voxel in 1 tile: another" in said
    assert "(<code>gnd map status</code>)" in said
    assert "(<code>confirmation.parked_h</code>)" in said
    assert "`" not in said


def test_the_operators_room_shows_the_vehicles_of_a_finished_run(finished_run: Path) -> None:
    by_vehicle = json.loads((finished_run / "summary.json").read_text())["traffic"]["by_vehicle"]
    told = json.loads(CliRunner().invoke(status, [str(finished_run), "--json"], catch_exceptions=False).stdout)
    driven = {one["vehicle"]: one["drive_km"] for one in told["vehicles"]}
    assert driven == pytest.approx({name: own["drive_km"] for name, own in by_vehicle.items()}, abs=1e-3)
    assert (told["parts_waiting"], told["alerts"]) == (0, []), "a run that has ended misses no shard"
    screen = CliRunner().invoke(status, [str(finished_run)], catch_exceptions=False).stdout
    for name, own in by_vehicle.items():
        (line,) = (line for line in screen.splitlines() if line.startswith(name))
        assert f"{size_text(own['down_wire_bytes'])}" in line
        assert f"{size_text(own['up_wire_bytes'])}" in line
    assert CliRunner().invoke(status, [str(finished_run), "--check"]).exit_code == 0


def test_the_list_holds_the_changes_of_the_map(finished_run: Path) -> None:
    run = read_finished_run(finished_run)
    assert run.changes is not None
    assert run.changes.changes
    listed = sum(one.voxels for one in run.changes.changes) + run.changes.alone
    new_or_deleted = sum(one.voxels for one in run.changes.changes if one.change != "modified")
    assert 0 < new_or_deleted <= listed <= sum(one.changed_voxels() for one in run.tiles)
    assert all(one.vehicles in (1, 2) and one.reports > 0 for one in run.changes.changes)
    text = report_page(run, pictures=0)
    table = text[text.index("All changes in figures") :]
    assert [f"{one.lat_deg:.7f}" in table for one in run.changes.changes] == [True] * len(run.changes.changes)


def test_the_truth_gives_f1_confusion_and_a_third_picture(copy: Path, truth: Path) -> None:
    summary = json.loads((copy / "summary.json").read_text())
    stages = {"before": 40.0, "single": 51.2, "after": 61.5}
    summary["f1"] = {**stages, "levels": dict.fromkeys(("observable", "all", "scored"), stages)}
    (copy / "summary.json").write_text(json.dumps(summary))
    without = read_finished_run(copy)
    assert any("--truth" in line for line in without.missing), "a simulated run whose truth lies elsewhere says so"
    run = read_finished_run(copy, truth)
    text = report_page(run, pictures=1)
    words = Reader(text).words
    assert "40.0 → 61.5 %" in words
    assert run.truth is not None
    observable = run.truth.counts("observable")
    row = re.search(r"true deleted</td>(.*?)</tr>", text)
    assert row is not None
    cells = [int(cell.replace(",", "")) for cell in re.findall(r"<td>([\d,]+)</td>", row[1])]
    assert sum(cells) == observable["deleted"] > 0
    maps, change = pictures_of(text)[:3], pictures_of(text)[3]
    assert len(maps) == 3
    assert _size(change)[0] == pytest.approx(1.5 * _size(pictures_of(report_page(without, 1))[2])[0], abs=2)


def _size(png: bytes) -> tuple[int, int]:
    return struct.unpack(">II", png[16:24])  # type: ignore[return-value]


def test_nothing_comes_from_elsewhere_and_nothing_runs(finished_run: Path) -> None:
    text = report_page(read_finished_run(finished_run), pictures=1)
    read = Reader(text)
    assert not {"script", "link", "iframe", "object", "embed", "use", "image", "base", "form"} & {
        t for t, _ in read.tags
    }
    for tag, attributes in read.tags:
        assert not any(name.startswith("on") for name in attributes), tag
        assert str(attributes.get("src", "data:image/png;base64,")).startswith("data:image/png;base64,")
        assert str(attributes.get("href", "#")).startswith("#")
        assert not {"srcset", "action", "xlink:href"} & set(attributes)
    assert "url(" not in text
    assert "@import" not in text
    anchors = {attributes["id"] for _, attributes in read.tags if "id" in attributes}
    assert {str(a["href"])[1:] for t, a in read.tags if t == "a"} <= anchors
    assert all(a.get("alt") for t, a in read.tags if t == "img")


def test_names_cannot_become_markup(finished_run: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(finished_run, tmp_path / EVIL.replace("/", "")))
    mark = json.loads((run / "run.json").read_text())
    mark |= {"drives": [f"{EVIL}.mcap"], "map": f"$(rm -rf {EVIL})", "software": {EVIL: EVIL}, "groups": EVIL}
    (run / "run.json").write_text(json.dumps(mark))
    (run / "settings.toml").write_text(f"</pre><script>{EVIL}</script>")
    for path in run.glob("agents/*/result.json"):
        result = json.loads(path.read_text()) | {"vehicle": EVIL, "sensor_model": EVIL, "last_error": EVIL}
        path.write_text(json.dumps(result))
    for path in run.glob("ledger/*.jsonl"):
        path.write_text(path.read_text().replace(path.stem, "</td><script>x"))
    summary = json.loads((run / "summary.json").read_text())
    summary["settings_sha256"] = EVIL
    summary["named_vehicles"] = [{"says": EVIL}]
    (run / "summary.json").write_text(json.dumps(summary))
    text = report_page(read_finished_run(run), pictures=1)
    read = Reader(text)
    assert "script" not in {tag for tag, _ in read.tags}
    assert all("onerror" not in attributes and attributes.get("src") != "x" for _, attributes in read.tags)
    assert read.words.count("<img src=x") >= 6
    command = next(line for line in "".join(read.text).splitlines() if "gnd fleet --config" in line)
    assert "'$(rm -rf" in command, "what is copied into a shell is quoted"


@pytest.mark.parametrize("part", ["summary.json", "settings.toml", "ledger", "agents", "updates.jsonl"])
def test_a_run_without_a_part_has_a_report_that_says_so(copy: Path, part: str) -> None:
    path = copy / part
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    run = read_finished_run(copy)
    words = Reader(report_page(run, pictures=0)).words
    assert "The map" in words
    told = {
        "summary.json": "Missing: summary.json (has the run ended?): No such file or directory",
        "settings.toml": "No settings were kept",
        "ledger": "No vehicle left an account of its traffic",
        "agents": "No vehicle left a result",
        "updates.jsonl": "",
    }
    assert told[part] in words


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[1]", b"\xff\xfe", b'{"f1": 7, "localisation_p95": [], "traffic": null}', b"[" * 100_000]
)
def test_a_damaged_summary_or_mark_does_not_spoil_the_report(copy: Path, content: bytes) -> None:
    (copy / "summary.json").write_bytes(content)
    (copy / "run.json").write_bytes(content)
    for path in copy.glob("agents/*/result.json"):
        path.write_bytes(
            b'{"vehicle": "v", "localisation": {"t_ns": ["x"]}, "health": [1], "doubts": 3, "scans_bad": 4}'
        )
    words = Reader(report_page(read_finished_run(copy), pictures=0)).words
    assert "has no summary" in words or "damaged" in words


def test_what_is_no_run_is_refused_in_one_line(copy: Path, tmp_path: Path) -> None:
    with pytest.raises(ReportError, match="no run at"):
        read_finished_run(tmp_path / "absent")
    with pytest.raises(ReportError, match=r"holds no run \(run\.json is missing\)"):
        read_finished_run(tmp_path)
    with pytest.raises(TruthError, match="cannot read the truth file"):
        read_finished_run(copy, tmp_path / "absent.npz")
    store = (copy / "store.sqlite").read_bytes()
    (copy / "store.sqlite").write_bytes(store[: len(store) // 2])
    with pytest.raises(ReportError, match="cannot read the map of the run"):
        read_finished_run(copy)
    (copy / "store.sqlite").unlink()
    with pytest.raises(ReportError, match="holds no map"):
        read_finished_run(copy)


def test_the_command_writes_the_page_and_says_what_is_missing(copy: Path, tmp_path: Path) -> None:
    (copy / "settings.toml").unlink()
    said = invoke(copy, "--pictures", 0)
    assert f"report written: {copy / 'report.html'}" in said
    assert "missing: settings.toml" in said
    told = json.loads(invoke(copy, "--pictures", 0, "--json", "-o", tmp_path / "a.html"))
    assert told["bytes"] == (tmp_path / "a.html").stat().st_size
    assert told["missing"] == ["settings.toml: No such file or directory"]
    with pytest.raises(PageError, match="does not exist"):
        invoke(copy, "-o", tmp_path / "absent" / "a.html")


def test_without_a_browser_the_page_is_written_and_the_pdf_is_explained(
    copy: Path, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ReportError, match=r"no PDF: none of chromium.* is installed .*print it there"):
        invoke(copy, "--pictures", 0, "--pdf", tmp_path / "a.pdf")
    assert (copy / "report.html").is_file()
    assert not (tmp_path / "a.pdf").exists()


def test_a_browser_that_fails_is_an_error_that_says_why(copy: Path, tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "chromium").write_text("#!/bin/sh\necho no display >&2\nexit 3\n")
    (tmp_path / "chromium").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    with pytest.raises(ReportError, match="ended with code 3: no display"):
        invoke(copy, "--pictures", 0, "--pdf", tmp_path / "a.pdf")
    (tmp_path / "chromium").write_text("#!/bin/sh\nexit 0\n")
    with pytest.raises(ReportError, match="printed no PDF"):
        invoke(copy, "--pictures", 0, "--pdf", tmp_path / "a.pdf")


needs_browser = pytest.mark.skipif(printing.browser() is None, reason="no Chromium on this system")


@needs_browser
def test_the_pdf_holds_the_report_on_light_paper(copy: Path, tmp_path: Path) -> None:
    invoke(copy, "--pictures", 2, "--pdf", tmp_path / "a.pdf")
    pdf = (tmp_path / "a.pdf").read_bytes()
    assert pdf.startswith(b"%PDF-")
    assert len(re.findall(rb"/Type\s*/Page\b", pdf)) >= 3
    packed = (pdf[begin.end() :] for begin in re.finditer(rb"stream\r?\n(?=x\x9c)", pdf))
    assert sum(len(zlib.decompressobj().decompress(one)) for one in packed) > 10_000  # each ends by itself
    assert [entry.name for entry in tmp_path.iterdir() if "partial" in entry.name] == []


MEASURE = """<script>
document.title = [document.documentElement.scrollWidth, innerWidth,
  ...[...document.images].map(i => i.complete && i.naturalWidth > 0 ? Math.round(i.getBoundingClientRect().width) : 0)
].join(' ');
</script>"""


@needs_browser
@pytest.mark.parametrize("width", [390, 1200])
def test_a_browser_shows_every_picture_without_scrolling_sideways(
    finished_run: Path, tmp_path: Path, width: int
) -> None:
    text = report_page(read_finished_run(finished_run), pictures=2)
    (tmp_path / "r.html").write_text(text + MEASURE)
    frame = f'<body style="margin:0"><iframe src="r.html" style="border:0;width:{width}px;height:3000px"></iframe>'
    wait = "<script>onload = () => {document.title = frames[0].document.title}</script>"
    (tmp_path / "frame.html").write_text(f"<!doctype html><title></title>{frame}{wait}")
    done = subprocess.run(
        [str(printing.browser()), "--headless", "--no-sandbox", "--disable-gpu", "--allow-file-access-from-files",
         f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", (tmp_path / "frame.html").as_uri()],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    found = re.search(r"<title>(\d+) (\d+) ([\d ]+)</title>", done.stdout)
    assert found is not None, done.stderr[-2000:]
    assert int(found[1]) <= int(found[2]) == width
    sizes = [int(size) for size in found[3].split()]
    assert len(sizes) == 5
    assert all(250 <= size <= width for size in sizes)


# Machado, Oliveira and Fernandes (2009), severity 1.0: how people without one kind of cones see linear RGB.
_BLIND = {
    "red": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "green": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "blue": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
    "none": np.eye(3).tolist(),
}


@pytest.mark.parametrize("kind", sorted(_BLIND))
def test_the_classes_are_told_apart_by_everybody(kind: str) -> None:
    shown = (ChangeClass.NORMAL, ChangeClass.NEW, ChangeClass.MODIFIED, ChangeClass.DELETED)
    lab = [_lab(SAFE_COLOURS[one], np.array(_BLIND[kind])) for one in shown]
    apart = [float(np.linalg.norm(a - b)) for n, a in enumerate(lab) for b in lab[n + 1 :]]
    assert min(apart) > 25.0


def _lab(colour: str, seen: np.ndarray) -> np.ndarray:
    """CIE L*a*b* (D65) of a colour as somebody sees it."""
    rgb = np.array([int(colour[n : n + 2], 16) / 255 for n in (1, 3, 5)])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    xyz = to_xyz @ np.clip(seen @ linear, 0, 1) / np.array([0.9505, 1.0, 1.089])
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def test_health_is_shared_out_over_the_drive() -> None:
    s = 10**9
    result = {
        "health": [{"t_ns": 0, "health": "lost"}, {"t_ns": 2 * s, "health": "good"}, {"t_ns": 8 * s, "health": "lost"}],
        "localisation": {"t_ns": [1 * s, 10 * s]},
    }
    assert health_shares(result) == pytest.approx({"good": 0.6, "degraded": 0.0, "lost": 0.4})
    assert health_shares({"health": []}) is None
    assert health_shares({"health": [{"t_ns": 5, "health": "good"}]}) is None
