"""Install the packages of dist/ into fresh environments, and run real work there, far from the checkout.

For each Python: the wheel with `[all]`, and a small job from end to end: a street is simulated and mapped, boxes are
put into it, a fleet of two vehicles finds them over real sessions, and its run is reported and served as a page. Then
the source archive is built and installed into an environment of its own, which must come to hold the same files.
"""

import json
import os
import re
import subprocess
import tempfile
import time
import urllib.request
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import click

from tools.changelog import ROOT
from tools.dist import sha256

START_S: Final = 120.0
_PAGE: Final = re.compile(r"http://127\.0\.0\.1:\d+/\S*")


class InstallationError(Exception):
    """What was installed does not do its work; the message says which command and what it printed."""


@dataclass(frozen=True, slots=True)
class Environment:
    """A virtual environment.

    Attributes:
        folder: of the environment.
        work: folder of the job, outside the checkout; the current one of every command.
    """

    folder: Path
    work: Path

    def run(self, *words: str, expected: int = 0) -> str:
        """Run a program of the environment and return what it printed.

        Raises:
            InstallationError: it ended with another status.
        """
        done = subprocess.run(
            [str(self.folder / "bin" / words[0]), *words[1:]],
            check=False, cwd=self.work, env=self.variables(), capture_output=True, text=True, timeout=900,
        )  # fmt: skip
        if done.returncode != expected:
            told = f"{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
            raise InstallationError(f"{' '.join(words)} ended with {done.returncode}:\n{told}")
        return done.stdout

    def variables(self) -> dict[str, str]:
        """An environment that nothing of the checkout or of this user gets into."""
        own = {"PATH": f"{self.folder / 'bin'}:/usr/bin:/bin", "HOME": str(self.work), "LANG": "C.UTF-8"}
        kept = ("PIP_", "SSL_", "OPENBLAS_", "NUMBA_NUM_THREADS")
        return own | {name: value for name, value in os.environ.items() if name.startswith(kept)}


def made(python: str, folder: Path, what: str) -> Environment:
    """Make an environment with pip, and install into it with the pinned versions.

    Args:
        python: interpreter.
        folder: where environment and job go; it must not be there.
        what: what pip is to install.
    """
    work = folder / "work"
    work.mkdir(parents=True)
    subprocess.run([python, "-m", "venv", str(folder / "venv")], check=True)
    environment = Environment(folder / "venv", work)
    quiet = ("--quiet", "--disable-pip-version-check", "--no-cache-dir" if "tar.gz" in what else "--progress-bar=off")
    environment.run("pip", "install", *quiet, "-c", str(ROOT / "constraints.txt"), what)
    return environment


def small_job(environment: Environment) -> dict[str, object]:
    """From a simulated street to the report of a run; returns the summary of the run.

    Raises:
        InstallationError: a command failed, or the run did not do what a run does.
    """
    gnd = environment.run
    gnd("gnd", "sim", "world", "write", "street.json", "--seed", "11", "--length", "100")
    gnd("gnd", "sim", "drive", "street.json", "before.mcap", "--state", "before", "--cars", "0", "--scans", "90")
    gnd("gnd", "map", "build", "-o", "map.sqlite", "before.mcap")
    gnd("gnd", "map", "verify", "map.sqlite")
    gnd(
        "gnd", "fleet", "--drives", "before.mcap", "--made-up", "4", "--map", "map.sqlite", "--agents", "2",
        "--shards", "1", "--out", "run", "--link", "none", "--no-page",
    )  # fmt: skip
    gnd("gnd", "report", "run")
    gnd("gnd", "traffic", "run")
    gnd("gnd", "status", "run", "--json")
    summary: dict[str, object] = json.loads((environment.work / "run" / "summary.json").read_text(encoding="utf-8"))
    if not summary["tiles_published"] or summary["reports_lost"]:
        raise InstallationError(f"the run published no tile, or lost a report: {summary}")
    return summary


def served_page(environment: Environment) -> int:
    """Serve the map of the run, and fetch the page and its program; returns their bytes.

    Raises:
        InstallationError: no address within two minutes.
    """
    words = [str(environment.folder / "bin" / "gnd"), "serve", "run", "--port", "0"]
    log = environment.work / "serve.log"
    with log.open("w", encoding="utf-8") as file:
        server = subprocess.Popen(words, cwd=environment.work, env=environment.variables(), stdout=file, stderr=file)
    try:
        deadline_s = time.monotonic() + START_S
        while (found := _PAGE.search(log.read_text(encoding="utf-8"))) is None:
            if server.poll() is not None or time.monotonic() > deadline_s:
                raise InstallationError(f"gnd serve: {log.read_text(encoding='utf-8')}")
            time.sleep(0.1)
        address = found[0].rstrip("/")
        return sum(len(_fetched(f"{address}/{name}")) for name in ("", "page.js", "page.css", "api/map"))
    finally:
        server.terminate()
        server.wait(timeout=30)


def _fetched(url: str) -> bytes:
    with urllib.request.urlopen(url, timeout=START_S) as answer:
        content: bytes = answer.read()
    return content


def installed_files(environment: Environment) -> dict[str, str]:
    """SHA-256 by name of the installed files of the package."""
    (folder,) = environment.folder.glob("lib/python*/site-packages/gnd")
    files = (path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    return {path.relative_to(folder).as_posix(): sha256(path) for path in files}


def try_python(python: str, wheel: Path, archive: Path, folder: Path) -> str:
    """Wheel and source archive with one Python; returns a line that says what was done.

    Raises:
        InstallationError: something does not work, or the two differ.
    """
    started_s = time.monotonic()
    full = made(python, folder / "wheel", f"{wheel}[all]")
    says = full.run("python", "-c", "import platform; print(platform.python_version())").strip()
    version = full.run("gnd", "--version").split()[-1]
    if version not in wheel.name:
        raise InstallationError(f"gnd --version says {version}, the wheel is {wheel.name}")
    full.run("gnd", "doctor")
    summary = small_job(full)
    page_bytes = served_page(full)
    bare = made(python, folder / "archive", str(archive))
    if bare.run("gnd", "--version").split()[-1] != version or installed_files(bare) != installed_files(full):
        raise InstallationError(f"{archive.name} and {wheel.name} do not install the same")
    bare.run("gnd", "map", "info", str(full.work / "map.sqlite"))
    bare.run("gnd", "doctor")
    return (
        f"Python {says}: gnd {version}; {summary['tiles_published']} tiles published, "
        f"{summary['reports_sent']} reports, {page_bytes:,} bytes of the page, {len(installed_files(full))} files, "
        f"{time.monotonic() - started_s:.0f} s"
    )


@click.command(help=__doc__)
@click.option("--dist", type=click.Path(path_type=Path, exists=True), default=ROOT / "dist", help="Where both lie.")
@click.option("--python", "pythons", multiple=True, default=["python3.11"], help="Interpreter; repeatable.")
def main(dist: Path, pythons: tuple[str, ...]) -> None:
    """Try each Python."""
    wheel = max(dist.glob("*.whl"), key=lambda path: path.stat().st_mtime)
    archive = dist / f"{wheel.name.removesuffix('-py3-none-any.whl')}.tar.gz"
    for python in pythons:
        with tempfile.TemporaryDirectory(prefix="gnd-installed-") as folder:
            try:
                click.echo(try_python(python, wheel.resolve(), archive.resolve(), Path(folder)))
            except InstallationError as error:
                raise click.ClickException(f"{python}: {error}") from None


if __name__ == "__main__":
    main()
