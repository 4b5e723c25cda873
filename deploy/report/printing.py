"""A page as PDF, printed by the Chromium or Chrome of this machine."""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Final

from gnd.deploy.errors import ReportError
from gnd.deploy.html_page import check_writable

BROWSERS: Final = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "microsoft-edge")
_LONGEST_S: Final = 180.0
_SAID: Final = 300


def browser() -> str | None:
    """The program that prints, None where there is none."""
    return next((found for name in BROWSERS if (found := shutil.which(name)) is not None), None)


def print_pdf(page: Path, pdf: Path) -> None:
    """Print a page; an earlier PDF is replaced at once.

    Args:
        page: an HTML file.
        pdf: the file to write.

    Raises:
        ReportError: there is no browser, or it prints nothing within three minutes.
        PageError: the PDF cannot be written there.
    """
    check_writable(pdf)
    program = browser()
    if program is None:
        raise ReportError(
            f"no PDF: none of {', '.join(BROWSERS)} is installed (Debian: apt-get install chromium); {page} is "
            "written: open it in any browser and print it there"
        )
    with tempfile.TemporaryDirectory(prefix="gnd-report-") as folder:
        printed = Path(folder) / "report.pdf"
        _run([program, *_options(Path(folder)), f"--print-to-pdf={printed}", page.resolve().as_uri()])
        if not printed.is_file() or not printed.read_bytes().startswith(b"%PDF-"):
            raise ReportError(f"{program} printed no PDF of {page}")
        partial = pdf.with_name(f"{pdf.name}.{os.getpid()}.partial")
        try:
            shutil.copyfile(printed, partial)
            partial.replace(pdf)
        except OSError as error:
            partial.unlink(missing_ok=True)
            raise ReportError(f"cannot write {pdf}: {error.strerror}") from error


def _options(profile: Path) -> list[str]:
    sandbox = ["--no-sandbox"] if os.geteuid() == 0 else []  # its sandbox does not run as root; the page is our own
    return [
        "--headless",
        *sandbox,
        "--disable-gpu",
        "--no-first-run",
        "--disable-dev-shm-usage",
        f"--user-data-dir={profile / 'profile'}",
        "--no-pdf-header-footer",
    ]


def _run(command: list[str]) -> None:
    try:
        done = subprocess.run(  # noqa: S603 - a program found by name, on a page of our own
            command, capture_output=True, timeout=_LONGEST_S, check=False, stdin=subprocess.DEVNULL
        )
    except subprocess.TimeoutExpired:
        raise ReportError(f"{command[0]} printed nothing within {_LONGEST_S:.0f} s") from None
    except OSError as error:
        raise ReportError(f"{command[0]} cannot be started: {error.strerror}") from error
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip()[-_SAID:]
        raise ReportError(f"{command[0]} ended with code {done.returncode}: {said}")
