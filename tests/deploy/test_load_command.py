import pytest
from click.testing import CliRunner
from load_testing import make_run

from gnd.deploy.cli import gnd
from gnd.deploy.errors import LoadError
from gnd.deploy.load.command import table_of


def said(*arguments):
    return CliRunner().invoke(gnd, ["load", *map(str, arguments)])


def test_what_cannot_be_is_refused_before_anything_starts(tmp_path):
    run = make_run(tmp_path / "run")
    for wrong, complaint in (
        (["--vehicles", 0, "--drives", run], "vehicles must be 1 to 20000"),
        (["--drives", tmp_path], "holds no run"),
        (["--settled", run], "--settled goes with --drives"),
        (["--drives", run, "--changed-share", 0.5], "--settled RUN"),
        (["--drives", run, "--secure", "--vehicles", 501], "500 is the most"),
        (["--drives", run, "--regions", 2], "--regions goes with --hosts"),
        (["--drives", run, "--hosts", 4, "--shards", 2], "--shards does not go with --hosts: there is one a region"),
        (["--drives", run, "--hosts", 4, "--store", "sqlite:s"], "--store does not go with --hosts"),
    ):
        result = said(*wrong)
        assert isinstance(result.exception, LoadError)
        assert complaint in str(result.exception)


def test_folders_are_looked_at_before_the_run(tmp_path):
    run = make_run(tmp_path / "run")
    assert "there is no folder" in said("--drives", run, "--json", tmp_path / "none" / "load.json").output
    assert "is not empty" in said("--drives", run, "--keep", run).output


@pytest.mark.parametrize("merged", [True, False])
def test_the_table_tells_what_is_not_known(merged):
    lags = {"p50": 0.1, "p95": 0.2, "max": None}
    figures = dict.fromkeys(
        ("vehicles", "streets", "reports", "acknowledged", "lost", "second_halves", "sent_whole", "questions"), 1
    )
    figures |= {"acks_per_s": 1.0, "ack_ms": lags, "word_s": lags, "merge_lag_s": lags, "notice_lag_s": lags}
    figures |= {"versions": 1, "offered_s": 1.0, "pace": "real", "cpu_share": {"cloud": 0.5}, "backlog_max": 3}
    figures |= {"kept_up": merged, "why_not": ["the queue grew"], "limit": "cloud"}
    figures |= {"drained_after_s": 0.5 if merged else None, "cpu_ms_per_report": 12.5 if merged else None}
    figures |= {"cpu_ms_by_part": {"workers": 12.5 if merged else None}}
    cells = [str(cell) for column in table_of(figures).columns for cell in column.cells]
    assert ("12.5 ms: workers 12.5" in cells) == merged
    assert "hosts" not in cells
    several = table_of(figures | {"hosts": {"host-0": ["router-0", "hub"], "host-1": ["shard-0"]}, "secure": True})
    assert several.title == "1 vehicles, with certificates"
    assert "host-0: router-0, hub; host-1: shard-0" in [str(cell) for row in several.columns for cell in row.cells]
    assert ("not known: not all was merged" in cells) != merged
    assert ("no: the queue grew" in cells) != merged
