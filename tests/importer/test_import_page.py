"""docs/import.md: every command of it prints what the page says."""

import re
from pathlib import Path

import pytest
from click.testing import CliRunner

from gnd.vehicle_agent.importer import FORMATS
from gnd.vehicle_agent.importer_cli import import_drives

PAGE = Path(__file__).resolve().parents[2] / "docs" / "import.md"
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


def commands() -> list[tuple[str, str]]:
    """Each command with the output that follows it."""
    found = []
    for block in re.findall(r"^```\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL):
        for part in re.split(r"^\$ gnd import ", block, flags=re.MULTILINE)[1:]:
            command, _, output = part.partition("\n")
            found.append((command, output))
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("command", "output"), commands(), ids=[command for command, _ in commands()])
def test_the_page_says_what_the_command_prints(shared_data, tmp_path, monkeypatch, command, output):
    """Words exactly, numbers to 5 %: estimates differ in their last digits from machine to machine."""
    for path in shared_data.iterdir():
        (tmp_path / path.name).symlink_to(path)
    (tmp_path / "ouster_golden").symlink_to(Path(__file__).parent / "ouster_golden")
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(import_drives, command.split())
    printed = result.stdout + (f"gnd: {result.exception}\n" if result.exception else "")
    assert NUMBER.sub("#", printed).split() == NUMBER.sub("#", output).split()
    shown, expected = ([float(one) for one in NUMBER.findall(text)] for text in (printed, output))
    assert shown == pytest.approx(expected, rel=0.05, abs=0.3)


def test_the_page_names_every_format():
    text = PAGE.read_text()
    assert [name for name in FORMATS if f"`{name}`" not in text] == []
    assert len(commands()) >= 7
