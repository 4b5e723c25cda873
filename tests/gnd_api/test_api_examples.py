"""The programs in examples/ and the blocks of docs/api.md, run for real: a router, a store, a merger, a drive."""

import re
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from api_testing import HERE, ROOT, Cloud, Program, gaussian_tile
from changed_street import SCANS

from gnd.fleet_bus.config import DEFAULT_ENDPOINT

EXAMPLES = ROOT / "examples"
TESTED = {"compare_versions", "feed_vehicle", "follow_region", "localise_drive", "read_map"}
TESTED_ELSEWHERE = {"subscribe"}
Start = Callable[..., Program]


def done(start: Start, example: str, *arguments: str) -> list[str]:
    program = start(str(EXAMPLES / f"{example}.py"), *arguments)
    assert program.end() == 0, program.lines
    return program.lines


def test_every_example_is_tested() -> None:
    assert {path.stem for path in EXAMPLES.glob("*.py")} == TESTED | TESTED_ELSEWHERE
    named = set(re.findall(r"`(\w+)\.py`", (ROOT / "docs" / "api.md").read_text()))
    assert named == TESTED | TESTED_ELSEWHERE


def test_read_map(cloud: Cloud, start: Start, tmp_path: Path) -> None:
    lines = done(start, "read_map", str(cloud.store.path), "13033/**", "--out", str(tmp_path / "columns.npz"))
    assert lines[0] == "layers ndt, signs; 4 Gaussians of 2 tiles"
    with np.load(tmp_path / "columns.npz") as columns:
        assert columns["mean_m"].shape == (4, 3)
    assert done(start, "read_map", str(cloud.store.path), "00000/**") == ["layers ndt, signs; 0 Gaussians of 0 tiles"]


def test_compare_versions(cloud: Cloud, start: Start) -> None:
    cloud.publish(gaussian_tile(HERE, 5, 9, 71))
    (line,) = done(start, "compare_versions", str(cloud.store.path), "--tile", HERE.path)
    assert re.fullmatch(r"v2 \d{4}-\d\d-\d\d \d\d:\d\d \+1 -1 ~0 voxels", line)
    since = done(start, "compare_versions", str(cloud.store.path), "--since", "2020-01-01T00:00:00Z")
    assert since == ["+5 -0 ~0 voxels in 3 tiles"]


def test_follow_region_until_ctrl_c(cloud: Cloud, start: Start) -> None:
    program = start(
        str(EXAMPLES / "follow_region.py"), HERE.path, "--layer", "ndt", "--layer", "signs", "--connect", cloud.endpoint
    )
    assert program.line("ndt") == f"ndt {HERE.path} v1 existing: 3 Gaussians"
    assert program.line("signs") == f"signs {HERE.path} v1 existing: 3 features"
    cloud.publish(gaussian_tile(HERE, 5))
    assert re.fullmatch(rf"ndt {HERE.path} v2 (base|missed): 1 Gaussians, before 3 Gaussians", program.line("ndt"))
    program.process.send_signal(signal.SIGINT)
    assert program.end() == 0
    assert len(program.lines) == 3


def test_examples_without_a_router_say_so_in_the_last_line(start: Start, free_port: int) -> None:
    program = start("-c", f"import gnd; gnd.connect('tcp/127.0.0.1:{free_port}', timeout_s=0.3)")
    assert program.end() == 1
    assert re.search(rf"NoRouter: no router at tcp/127.0.0.1:{free_port} for 0.3 s", program.lines[-1])


@pytest.mark.slow
def test_localise_drive(street_files: tuple[Path, Path], start: Start) -> None:
    lines = [line for line in done(start, "localise_drive", *map(str, street_files)) if "/" not in line]
    assert re.fullmatch(rf"car: \d+ poses of {SCANS} scans, \d+\.\d m", lines[0])
    assert len(lines) - 1 == int(lines[0].split()[1]) > SCANS / 2


@pytest.mark.slow
def test_feed_vehicle_and_upload(street_files: tuple[Path, Path], cloud: Cloud, start: Start) -> None:
    merger = ("-m", "gnd.deploy.cli", "merger", "--store", str(cloud.store.path), "--connect", cloud.endpoint)
    start(*merger).line("merger")
    lines = done(start, "feed_vehicle", *map(str, street_files), "--connect", cloud.endpoint)
    assert sum("poses are final" in line for line in lines) == SCANS
    (told,) = [line for line in lines if " reports, " in line]
    uploaded = [line for line in lines if line.endswith(" stored")]
    assert len(uploaded) == int(told.split()[0]) > 0


@pytest.mark.slow
def test_the_blocks_of_the_page_run(
    street_files: tuple[Path, Path], cloud: Cloud, tmp_path: Path, start: Start
) -> None:
    cloud.publish(gaussian_tile(HERE, 5, 9, 71))
    for name, path in (("drive.mcap", street_files[0]), ("street.sqlite", street_files[1])):
        shutil.copy(path, tmp_path / name)
    assert cloud.store.path == tmp_path / "map.sqlite"
    blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / "docs" / "api.md").read_text(), re.M | re.S)
    assert len(blocks) == 6
    assert sum(DEFAULT_ENDPOINT in block for block in blocks) == 2
    (tmp_path / "page.py").write_text("\n".join(blocks).replace(DEFAULT_ENDPOINT, cloud.endpoint))
    program = start("page.py")
    assert program.end() == 0, program.lines
    assert "('ndt', 'signs')" in program.lines
    assert "1 1 0 voxels" in program.lines
