"""Build the source archive and the wheel into dist/, the same bytes from the same commit, and look at both.

The wheel is built from the unpacked source archive, so that what is in the one is enough for the other. Times inside
are those of the commit (SOURCE_DATE_EPOCH); what builds is pinned in constraints.txt.
"""

import gzip
import hashlib
import os
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Callable
from fnmatch import fnmatch
from pathlib import Path
from typing import Final

import click

from tools.changelog import ROOT, ReleaseError, check_ready

NOT_PACKAGED: Final = (
    "deploy/Dockerfile", "deploy/compose*.yaml", "deploy/requirements.lock", "deploy/database/*",
    "deploy/kubernetes/*", "deploy/monitoring/*.yaml", "deploy/systemd/*", "schemas/golden/*",
)  # fmt: skip
"""Files of the package folders that stay in the repository: for those who deploy from a checkout, and for tests."""


def build(out: Path, root: Path = ROOT) -> tuple[Path, Path]:
    """Build the source archive and, from it, the wheel.

    Returns:
        Paths of the archive and the wheel.

    Raises:
        ReleaseError: something cannot be built.
    """
    out.mkdir(parents=True, exist_ok=True)
    epoch_s = time_of_commit(root)
    with tempfile.TemporaryDirectory() as folder:
        packed = _built(root, Path(folder) / "archive", "--sdist", epoch_s)
        archive = out / packed.name
        repack(packed, archive, epoch_s)
        unpacked = Path(folder) / "unpacked"
        with tarfile.open(archive) as tar:
            tar.extractall(unpacked, filter="data")
        (inside,) = unpacked.iterdir()
        wheel = _built(inside, Path(folder) / "wheel", "--wheel", epoch_s)
        kept = out / wheel.name
        kept.write_bytes(wheel.read_bytes())
    return archive, kept


def time_of_commit(root: Path) -> int:
    """Seconds of the epoch of what is built: $SOURCE_DATE_EPOCH, or the commit's; 1980 without git, as zip has it."""
    told = os.environ.get("SOURCE_DATE_EPOCH")
    if told:
        return int(told)
    asked = subprocess.run(["git", "log", "-1", "--format=%ct"], check=False, cwd=root, capture_output=True, text=True)
    return int(asked.stdout) if asked.returncode == 0 and asked.stdout.strip() else 315_532_800


def _built(source: Path, out: Path, kind: str, epoch_s: int) -> Path:
    environment = os.environ | {"SOURCE_DATE_EPOCH": str(epoch_s), "PIP_CONSTRAINT": str(ROOT / "constraints.txt")}
    done = subprocess.run(
        [sys.executable, "-m", "build", kind, "--outdir", str(out), str(source)],
        check=False, capture_output=True, text=True, env=environment, umask=0o022,
    )  # fmt: skip
    if done.returncode:
        raise ReleaseError(f"{kind} of {source}:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}")
    (made,) = out.iterdir()
    return made


def repack(packed: Path, out: Path, epoch_s: int) -> None:
    """Write an archive anew with nothing in it of the machine and the hour: sorted names, one time, no owner."""
    with (
        tarfile.open(packed) as old,
        out.open("wb") as file,
        gzip.GzipFile(filename="", mode="wb", fileobj=file, mtime=epoch_s) as squeezed,
        tarfile.open(fileobj=squeezed, mode="w", format=tarfile.PAX_FORMAT) as new,
    ):
        for member in sorted(old.getmembers(), key=lambda one: one.name):
            content = old.extractfile(member) if member.isfile() else None
            member.mtime, member.uid, member.gid, member.uname, member.gname = epoch_s, 0, 0, "", ""
            member.mode = 0o755 if member.isdir() or member.mode & 0o100 else 0o644
            member.pax_headers = {}
            new.addfile(member, content)


def check_contents(wheel: Path, root: Path = ROOT) -> int:
    """Compare a wheel with the files that git knows in the packages' folders.

    Returns:
        Number of files of the package in the wheel.

    Raises:
        ReleaseError: a file is missing, differs, or is none of git's.
    """
    wanted = {name: path for name, path in _files_of_packages(root).items() if not _stays(path, root)}
    with zipfile.ZipFile(wheel) as archive:
        held = {name: archive.read(name) for name in archive.namelist() if ".dist-info/" not in name}
    missing = sorted(wanted.keys() - held.keys())
    foreign = sorted(held.keys() - wanted.keys())
    other = sorted(name for name in wanted.keys() & held.keys() if wanted[name].read_bytes() != held[name])
    for fault, names in (("not in the wheel", missing), ("not known to git", foreign), ("not as in git", other)):
        if names:
            raise ReleaseError(f"{wheel.name}: {len(names)} files {fault}: {', '.join(names[:8])}")
    return len(held)


def _files_of_packages(root: Path) -> dict[str, Path]:
    """Path by name below `gnd/` of all that git knows in the folders that src/gnd links to, and of src/gnd itself."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=root, capture_output=True, text=True, check=True).stdout
    folders = {one.name for one in (root / "src" / "gnd").iterdir() if one.is_symlink()}
    found = {}
    for name in filter(None, listed.split("\0")):
        path = root / name
        if name.startswith("src/gnd/") and not path.is_symlink():
            found[name.removeprefix("src/")] = path
        elif name.split("/")[0] in folders:
            found[f"gnd/{name}"] = path
    return found


def _stays(path: Path, root: Path) -> bool:
    name = path.relative_to(root).as_posix()
    return any(fnmatch(name, pattern) for pattern in NOT_PACKAGED)


def check_same(make: Callable[[Path], tuple[Path, Path]], first: tuple[Path, Path]) -> None:
    """Build once more and compare.

    Raises:
        ReleaseError: an archive has other bytes than before.
    """
    with tempfile.TemporaryDirectory() as folder:
        for one, again in zip(first, make(Path(folder)), strict=True):
            if sha256(one) != sha256(again):
                raise ReleaseError(f"{one.name}: another {sha256(again)} when built again, instead of {sha256(one)}")


def sha256(path: Path) -> str:
    """Hash of a file in hex."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


@click.command(help=__doc__)
@click.option("--out", type=click.Path(path_type=Path), default=ROOT / "dist", help="Where both go.  [default: dist/]")
@click.option("--twice", is_flag=True, help="Build once more, and compare the bytes.")
@click.option("--version", "only_version", is_flag=True, help="Print the version that would be built, and end.")
def main(out: Path, *, twice: bool, only_version: bool) -> None:
    """Build and check."""
    from setuptools_scm import get_version

    version = get_version(str(ROOT), fallback_version="0.1.dev0")
    if only_version:
        click.echo(version)
        return
    try:
        check_ready(version)
        made = build(out)
        files = check_contents(made[1])
        if twice:
            check_same(build, made)
    except ReleaseError as error:
        raise click.ClickException(str(error)) from None
    subprocess.run([sys.executable, "-m", "twine", "check", "--strict", *map(str, made)], check=True)
    for one in made:
        click.echo(f"{sha256(one)}  {one.name}  {one.stat().st_size:,} bytes")
    click.echo(f"{files} files in the wheel, as git knows them{'; built twice, the same bytes' if twice else ''}")


if __name__ == "__main__":
    main()
