"""The page on HD maps shows what its commands print."""

import re
import shlex
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from gnd.deploy.features_cli import features

PAGE = Path(__file__).resolve().parents[2] / "docs" / "hd_maps.md"
MAPS = Path(__file__).parent / "maps"
BLOCKS = re.findall(r"```console\n(.*?)```", PAGE.read_text(), re.DOTALL)


@pytest.mark.parametrize("block", BLOCKS, ids=[block.split()[4].split("_")[0] for block in BLOCKS])
def test_commands_print_what_the_page_shows(
    block: str, shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(MAPS, tmp_path, dirs_exist_ok=True)
    for file in (shared_data / "av2_pit_overlap").glob("*/map/log_map_archive_*.json"):
        shutil.copy(file, tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    if not Path(block.split()[4]).exists():
        pytest.skip("real recording not found: ../shared/data/av2_pit_overlap")
    shown = ""
    for command in re.findall(r"^\$ gnd features (.*)$", block, re.MULTILINE):
        result = CliRunner().invoke(features, shlex.split(command), catch_exceptions=False)
        shown += f"$ gnd features {command}\n{result.stdout}"
    assert [line.rstrip() for line in shown.splitlines()] == block.splitlines()  # a table's title has blanks after it
    for back, file in (("back.xodr", "town.xodr"), ("back.osm", "bus_stop_area.osm")):
        assert not Path(back).exists() or Path(back).read_bytes() == Path(file).read_bytes()
