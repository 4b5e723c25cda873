"""`gnd traffic`: its forms of output, and what it says when it cannot."""

import csv
import io
import json
import sys

import pytest
from click.testing import CliRunner

from gnd.deploy.cli import main
from gnd.deploy.errors import PageError
from gnd.deploy.run_folder import RunFolder
from gnd.deploy.traffic_cli import traffic
from gnd.fleet_bus.errors import LinkError
from gnd.fleet_bus.ledger import Ledger
from gnd.fleet_bus.wire import WireBytes


@pytest.fixture
def run(tmp_path):
    """Two vehicles drive 2 km in 100 s."""
    for name in ("car-1", "car-2"):
        ledger = Ledger(name)
        ledger.set_position(0.0, 10**18)
        ledger.record("down", "tile", 5000, "13033/03021/23031/22102", head_bytes=80)
        ledger.set_position(2000.0, 10**18 + 100 * 10**9)
        ledger.record("up", "change", 2000, head_bytes=60)
        ledger.record_wire(WireBytes(3000, 6000, 1, 156, 104, 0, 1448, 52))
        ledger.write_jsonl(tmp_path / "run" / "ledger" / f"{name}.jsonl")
    return tmp_path / "run"


def invoke(*arguments: object) -> str:
    result = CliRunner().invoke(traffic, [str(argument) for argument in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def test_csv_rows_add_up_to_the_wire(run):
    rows = list(csv.DictReader(io.StringIO(invoke(run, "--csv"))))
    for agent in ("car-1", "car-2"):
        for direction, wire in (("up", 3000), ("down", 6000)):
            mine = [row for row in rows if (row["agent"], row["direction"]) == (agent, direction)]
            assert sum(int(row["wire_bytes"]) for row in mine) == wire
    change = next(row for row in rows if row["kind"] == "change")
    assert (change["messages"], change["app_bytes"], change["kB_per_km"]) == ("1", "2000", "1.000000")
    # 2000 B, 60 B of head, two packets' headers (1.42 of them filled) over 100 s at 1.9 Mbit/s.
    size = int(change["wire_bytes"])
    assert size == pytest.approx(2000 + 60 + 52 * 2060 / 1448, abs=1)
    assert float(change["share_3g"]) == pytest.approx(size * 8 / 1.9e6 / 100, abs=1e-9)
    assert {"share_4g", "share_5g"} <= set(change)


def test_csv_of_a_vehicle_that_never_drove_has_no_shares(tmp_path):
    ledger = Ledger("parked")
    ledger.record("up", "control", 10)
    ledger.write_jsonl(tmp_path / "run" / "ledger" / "parked.jsonl")
    row = next(csv.DictReader(io.StringIO(invoke(tmp_path / "run", "--csv"))))
    assert (row["kB_per_km"], row["share_3g"]) == ("0.000000", "")


def test_json_is_strict_and_its_lines_add_up(run):
    def refuse(name: str) -> None:
        pytest.fail(f"{name} is no JSON")

    report = json.loads(invoke(run, "--json", "--link", "none", "--link", "4g"), parse_constant=refuse)
    assert report["links"]["none"]["down_bit_s"] is None
    for agent in report["agents"]:
        for way in ("up", "down"):
            lines = [line for line in agent["lines"] if line["direction"] == way]
            assert sum(line["wire_bytes"] for line in lines) == agent[f"{way}_wire_bytes"]
    assert sum(line["wire_bytes"] for line in report["fleet"]["lines"]) == 18_000
    assert [(tile["tile"], tile["down_bytes"]) for tile in report["tiles"]] == [("13033/03021/23031/22102", 10_000)]


def test_a_page_is_written_beside_any_output(run, tmp_path):
    assert invoke(run, "--page", tmp_path / "a.html") == f"page written: {tmp_path / 'a.html'}\n"
    assert json.loads(invoke(run, "--json", "--page", tmp_path / "b.html"))["fleet"]["agents"] == 2
    assert (tmp_path / "a.html").read_text() == (tmp_path / "b.html").read_text()
    assert "Traffic of run" in (tmp_path / "a.html").read_text()


def test_one_output_has_one_form(run):
    result = CliRunner().invoke(traffic, [str(run), "--json", "--csv"])
    assert result.exit_code == 2
    assert "--json and --csv exclude each other" in result.output


def test_profiles_of_one_name_are_refused(run, tmp_path):
    (tmp_path / "mine.toml").write_text("[3g]\ndown_bit_s = 1e6\nup_bit_s = 1e5\n")
    with pytest.raises(LinkError, match="link profiles with one name: 3g; rename the table"):
        invoke(run, "--link", "3g", "--link", tmp_path / "mine.toml")


def test_a_page_that_cannot_be_written_is_an_error(run, tmp_path):
    with pytest.raises(PageError, match=r"cannot write the page .*absent/t\.html: the folder .*absent does not exist"):
        invoke(run, "--page", tmp_path / "absent" / "t.html")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nowhere"], "gnd: no run at nowhere nor at runs/nowhere"),
        (["."], "gnd: no ledgers in ledger: has an agent of this run been started?"),
        (["RUN", "--link", "6g"], "gnd: no link profile '6g'; there are: none, 3g, 4g, 5g"),
        (["RUN", "--link", "absent.toml"], "gnd: cannot read link profiles from absent.toml"),
        (["RUN", "--page", "/"], "gnd: cannot write the page /"),
    ],
)
def test_the_command_line_says_in_one_line_what_is_wrong(run, tmp_path, monkeypatch, capsys, arguments, said):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    given = [str(run) if word == "RUN" else word for word in arguments]
    monkeypatch.setattr(sys, "argv", ["gnd", "traffic", *given])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith(said)
    assert error.count("\n") == 1


def test_a_finished_run_has_its_page_and_its_lines(run, tmp_path):
    from gnd.deploy.account import account_traffic

    traffic = account_traffic(RunFolder(run))
    assert sum(line["wire_bytes"] for line in traffic["by_kind"]) == 18_000
    assert traffic["problem"] == ""
    assert "Traffic of run" in (run / "traffic.html").read_text()
    (run / "ledger" / "car-3.jsonl").write_text("no ledger")
    damaged = account_traffic(RunFolder(run))
    assert damaged["by_kind"] == [], "a run's summary does not fail for the sake of its page"
    assert "car-3.jsonl holds no ledger lines" in damaged["problem"]
