"""docs/how_to/export_map.md: its commands run, and print what it says."""

import re
from pathlib import Path

import pytest
from click.testing import CliRunner

from gnd.deploy.cli import gnd
from gnd.fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.street import StreetOptions, street
from gnd.tile_store.build import build_map
from gnd.tile_store.sqlite_store import SqliteStore

PAGE = Path(__file__).resolve().parents[3] / "docs" / "how_to" / "export_map.md"
NUMBER = re.compile(r"\d[\d.]*")


def commands() -> list[tuple[list[str], list[str]]]:
    """Words of each command and the lines that it prints; "..." stands for lines that the page leaves out."""
    blocks = re.findall(r"```console\n(.*?)```", PAGE.read_text(), re.DOTALL)
    found: list[tuple[list[str], list[str]]] = []
    for line in "".join(blocks).splitlines():
        if line.startswith("$ gnd "):  # `gnd map serve`, which does not end: test_map_serve_command.py
            found.append((line.removeprefix("$ gnd ").split(), []))
        else:
            found[-1][1].append(line)
    return [one for one in found if one[0][:2] != ["map", "serve"]]


def make_maps(folder: Path) -> None:
    world = street(5, StreetOptions(length_m=100.0))
    for name, state in (("base", "before"), ("after", "after")):
        config = DriveConfig("mapper", "VLP-16", state, errors=PERFECT, car_share=0.0, cruise_mps=14.0, scans=45)
        with SqliteStore(folder / f"{name}.sqlite") as store:
            build_map([simulate_drive(world, config, folder / f"{name}.mcap")], store)


@pytest.mark.slow
def test_the_page_shows_what_the_commands_print(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_maps(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert len(commands()) == 7
    for words, expected in commands():
        ran = CliRunner().invoke(gnd, words)
        assert ran.exit_code == 0, ran.output + repr(ran.exception)
        printed = ran.stdout.splitlines()
        if expected[0] == "...":
            expected = expected[1:]
            printed = printed[-len(expected) :]
        # Sizes hang on the versions of compressors, the class of a borderline cluster on the processor's rounding:
        # words exactly, numbers within 2 % or by one.
        assert [NUMBER.sub("#", line) for line in printed] == [NUMBER.sub("#", line) for line in expected]
        for line, wanted in zip(printed, expected, strict=True):
            numbers = [[float(n.rstrip(".")) for n in NUMBER.findall(text)] for text in (line, wanted)]
            near = [pytest.approx(n, rel=0.02, abs=1.0 if n.is_integer() else 0.011) for n in numbers[1]]
            assert numbers[0] == near, (line, wanted)
