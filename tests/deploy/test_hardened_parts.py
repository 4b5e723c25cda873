"""The parts as their units run them: no root, no capability, nothing to write but their folder, few system calls."""

import ctypes.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from hardened_launch import USER, allowed_calls
from numba.core.caching import UserProvidedCacheLocator
from parts_testing import Parts, until

import gnd

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
LAUNCH = Path(__file__).with_name("hardened_launch.py")
UNITS = sorted((DEPLOY / "systemd").glob("*.service"))
needs_root = pytest.mark.skipif(
    os.geteuid() != 0 or not all(map(shutil.which, ("unshare", "setpriv", "systemd-analyze"))),
    reason="needs root, util-linux and systemd-analyze",
)
needs_seccomp = pytest.mark.skipif(ctypes.util.find_library("seccomp") is None, reason="libseccomp is not installed")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder that the unprivileged user owns and may reach."""
    for parent in (tmp_path, *tmp_path.parents[:3]):
        parent.chmod(parent.stat().st_mode | 0o011)
    return tmp_path


def copy_kernels(cache: Path) -> None:
    """Kernels that are compiled already, where numba looks for them with `NUMBA_CACHE_DIR`: to save a minute."""
    cache.mkdir()
    source = Path(gnd.__file__).parent
    for index in source.glob("*/**/__pycache__/*.nb[ic]"):
        module = index.parent.parent / "any.py"  # the name of the folder hangs on the module's folder alone
        copy = cache / UserProvidedCacheLocator.get_suitable_cache_subpath(str(module))
        copy.mkdir(exist_ok=True)
        shutil.copy2(index, copy)


def hardened(folder: Path) -> Parts:
    before = [sys.executable, str(LAUNCH), str(DEPLOY / "systemd" / "gnd-store.service"), str(folder)]
    cache = folder / "cache"  # of compiled kernels: a unit has one of its own, the program's folder cannot be written
    copy_kernels(cache)
    environment = {**os.environ, "HOME": "/nonexistent", "TMPDIR": str(folder), "NUMBA_CACHE_DIR": str(cache)}
    parts = Parts(folder, before, environment)
    subprocess.run(["chown", "-R", f"{USER}:{USER}", folder], check=True)
    return parts


@needs_root
@needs_seccomp
@pytest.mark.slow
def test_the_parts_run_with_what_their_units_leave_them(folder: Path) -> None:
    parts = hardened(folder)
    try:
        for name in ("router", "store", "merger"):
            parts.start(name)
        for name in parts.running:
            until(f"{name} is well: {parts.log(name)}", lambda name=name: parts.is_healthy(name), 240.0)
        status = Path(f"/proc/{parts.running['store'].pid}/status").read_text()
        assert f"Uid:\t{USER}\t{USER}" in status
        assert "CapEff:\t0000000000000000" in status
        assert "CapBnd:\t0000000000000000" in status
        assert "NoNewPrivs:\t1" in status
        assert "Seccomp:\t2" in status
    finally:
        parts.kill()


@needs_root
@needs_seccomp
def test_what_the_units_forbid_fails(folder: Path) -> None:
    attempt = (
        "import os, socket\n"
        "def fails(what):\n"
        "    try:\n        what()\n"
        "    except OSError:\n        return\n"
        "    raise SystemExit('it was not refused')\n"
        "fails(lambda: open('/etc/gnd-was-here', 'w'))\n"
        "fails(lambda: os.setuid(0))\n"
        "fails(lambda: os.chroot('/'))\n"
        "fails(lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1)))\n"
        "fails(lambda: os.nice(-5))\n"
        "open(os.environ['TMPDIR'] + '/mine', 'w').close()\n"
        "socket.create_server(('127.0.0.1', 0)).close()\n"
    )
    hardened(folder)
    words = [sys.executable, str(LAUNCH), str(UNITS[0]), str(folder), sys.executable, "-c", attempt]
    done = subprocess.run(words, env={**os.environ, "TMPDIR": str(folder)}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


needs_analyze = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")


@needs_analyze
@pytest.mark.parametrize("is_in_database", [False, True], ids=["file", "postgresql"])
@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_systemd_calls_the_exposure_of_a_unit_ok(unit: Path, is_in_database: bool, tmp_path: Path) -> None:
    shutil.copy2(unit, tmp_path)
    if is_in_database:
        drop_in = tmp_path / f"{unit.name}.d" / "postgresql.conf"
        drop_in.parent.mkdir()
        shutil.copy2(DEPLOY / "systemd" / "postgresql.conf", drop_in)
    words = ["systemd-analyze", "security", "--offline=true", "--threshold=17", str(tmp_path / unit.name)]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr


@needs_analyze
@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_systemd_knows_every_line_of_a_unit(unit: Path, tmp_path: Path) -> None:
    """`verify` also wants the program, which is put there."""
    (tmp_path / unit.name).write_text(unit.read_text().replace("/opt/gnd/.venv/bin/gnd", "/bin/true"))
    done = subprocess.run(["systemd-analyze", "verify", str(tmp_path / unit.name)], capture_output=True, text=True)
    assert unit.name.replace("@", "@i") not in done.stderr, done.stderr
    assert unit.name not in done.stderr, done.stderr


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_a_unit_sees_its_own_identity_alone_and_may_write_there(unit: Path) -> None:
    text = unit.read_text()
    (identity,) = re.findall(r"--identity (\S+)", text)
    assert identity.startswith("/etc/gnd/")
    assert "\nTemporaryFileSystem=/etc/gnd:ro,mode=0755\n" in text
    assert re.findall(r"^BindPaths=(.*)$", text, re.M) == [identity]


@needs_root
def test_the_filters_leave_what_is_needed_and_take_what_is_not() -> None:
    allowed = allowed_calls(UNITS[0])
    assert {"read", "futex", "sendmsg", "mprotect", "prlimit64"} <= allowed
    assert not {"ptrace", "mount", "bpf", "reboot", "setuid", "init_module", "sched_setscheduler"} & allowed
