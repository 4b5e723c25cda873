"""What a person types wrong gets one line that says what to do, exit code 2, and leaves nothing half-written."""

import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest


def gnd(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "gnd.deploy.cli", *words], capture_output=True, text=True, timeout=120, check=False
    )


def assert_one_line(result: subprocess.CompletedProcess[str], *parts: str) -> None:
    assert result.returncode == 2, result
    assert result.stdout == ""
    last = result.stderr.strip().splitlines()[-1]
    assert "Traceback" not in result.stderr
    for part in parts:
        assert part in last, f"{part!r} is not in {last!r}"


@pytest.fixture
def taken_port() -> Iterator[int]:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        yield int(listener.getsockname()[1])


def test_a_seed_that_is_no_number(tmp_path: Path) -> None:
    assert_one_line(gnd("fleet", "--world-seed", "seoul", "--out", str(tmp_path / "run")), "seoul")
    assert not (tmp_path / "run").exists()


def test_a_world_that_does_not_exist(tmp_path: Path) -> None:
    assert_one_line(gnd("fleet", "--world-seed", "-4", "--out", str(tmp_path / "run")), "-4")


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert_one_line(gnd("fleet", "--out", str(tmp_path / "file" / "run")), "--out")


def test_a_folder_with_something_else_in_it(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    assert_one_line(gnd("fleet", "--out", str(tmp_path), "--overwrite"), "holds no run")
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


def test_a_port_that_is_taken(tmp_path: Path, taken_port: int) -> None:
    result = gnd("router", "--listen", f"tcp/127.0.0.1:{taken_port}")
    assert_one_line(result, str(taken_port))
    (tmp_path / "drive.mcap").write_bytes(b"")
    result = gnd("fleet", "--port", str(taken_port), "--out", str(tmp_path / "run"))
    assert_one_line(result, str(taken_port), "--port")
    assert not (tmp_path / "run").exists()


def test_a_corrupt_recording(tmp_path: Path) -> None:
    drive = tmp_path / "drive.mcap"
    drive.write_bytes(b"\x89MCAP0\r\n" + b"garbage" * 50)
    assert_one_line(gnd("fleet", "--drives", str(drive), "--out", str(tmp_path / "run")), "drive.mcap")


def test_no_recording_at_all(tmp_path: Path) -> None:
    assert_one_line(gnd("fleet", "--drives", str(tmp_path), "--out", str(tmp_path / "run")), "gnd import")
    assert_one_line(gnd("fleet", "--drives", str(tmp_path / "no"), "--out", str(tmp_path / "run2")), "no such drive")


def test_a_configuration_with_an_unknown_key(tmp_path: Path) -> None:
    config = tmp_path / "fleet.toml"
    config.write_text("agents = 2\nspeed_of_light = 3\n")
    assert_one_line(gnd("fleet", "--config", str(config), "--out", str(tmp_path / "run")), "speed_of_light", "agents")
    assert not (tmp_path / "run").exists()


def test_a_link_that_nobody_knows(tmp_path: Path) -> None:
    assert_one_line(gnd("fleet", "--link", "6g", "--out", str(tmp_path / "run")), "6g", "3g")
    assert not (tmp_path / "run").exists()


def test_a_region_that_is_none() -> None:
    assert_one_line(gnd("watch", "somewhere"), "lat,lon,radius")


def test_no_router() -> None:
    assert_one_line(gnd("watch", "**", "--connect", "tcp/127.0.0.1:1"), "gnd router")


def test_an_unknown_command() -> None:
    assert_one_line(gnd("flee"), "flee")


def test_help_needs_no_heavy_library() -> None:
    start = "import sys, gnd.deploy.cli; "
    code = f"{start}gnd.deploy.cli.gnd.main(['--help'], standalone_mode=False); print(sorted(sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for heavy in ("numba", "zenoh", "gtsam", "sklearn", "matplotlib"):
        assert f"'{heavy}'" not in result.stdout
