"""Sections of CHANGELOG.md by version, and the files that a release names its version in.

`python -m tools.changelog 0.2.0` prints a section; `python -m tools.changelog 0.2.0 --release` makes what is unreleased
that section, and writes version and date into CITATION.cff and the manifests.
"""

import datetime as dt
import re
from pathlib import Path
from typing import Final

import click

ROOT: Final = Path(__file__).resolve().parents[1]
UNRELEASED: Final = "Unreleased"
_HEADING: Final = re.compile(r"^## (?P<version>\S+)(?: \((?P<date>\d{4}-\d{2}-\d{2})\))?$", re.MULTILINE)
_RELEASE: Final = re.compile(r"\d+\.\d+\.\d+(?:(?:a|b|rc)\d+)?")
_CITED: Final = re.compile(r"^(?:version|date-released): .*\n", re.MULTILINE)
_IMAGE: Final = re.compile(r"(?<=newTag: )[^\s}]+")
_MANIFEST: Final = Path("deploy/kubernetes/overlays/production/kustomization.yaml")


class ReleaseError(Exception):
    """A release cannot be made as things are; the message says of what and why."""


def is_release(version: str) -> bool:
    """Whether a version is one that a tag gives, such as 0.2.0 or 0.2.0rc1, and none of the commits between."""
    return _RELEASE.fullmatch(version) is not None


def sections(changelog: str) -> dict[str, str]:
    """Text by version, in the order of the file, without the headings.

    Raises:
        ReleaseError: a version stands there twice, one has no date, or a section is empty.
    """
    found: dict[str, str] = {}
    headings = list(_HEADING.finditer(changelog))
    for one, following in zip(headings, [*headings[1:], None], strict=True):
        version = one["version"]
        if version in found:
            raise ReleaseError(f"CHANGELOG.md: two sections are called {version}")
        if version != UNRELEASED and not (is_release(version) and one["date"]):
            raise ReleaseError(f"CHANGELOG.md: a heading is '## {UNRELEASED}' or '## 1.2.3 (2026-01-31)': {one[0]!r}")
        found[version] = changelog[one.end() : following.start() if following else None].strip()
        if version != UNRELEASED and not found[version]:
            raise ReleaseError(f"CHANGELOG.md: the section of {version} is empty")
    return found


def section(version: str, root: Path = ROOT) -> str:
    """Text of a version.

    Raises:
        ReleaseError: it has none.
    """
    known = sections((root / "CHANGELOG.md").read_text(encoding="utf-8"))
    if version not in known:
        raise ReleaseError(f"CHANGELOG.md has sections for {', '.join(known)}, none for {version}")
    return known[version]


def check_ready(version: str, root: Path = ROOT) -> None:
    """Refuse to build a release that the documents do not know; versions between releases are always ready.

    Raises:
        ReleaseError: CHANGELOG.md has no section for it, or CITATION.cff or the manifests name another version.
    """
    known = sections((root / "CHANGELOG.md").read_text(encoding="utf-8"))
    if not is_release(version):
        return
    if version not in known:
        raise ReleaseError(f"CHANGELOG.md has no section for {version}: python -m tools.changelog {version} --release")
    if f"\nversion: {version}\n" not in (root / "CITATION.cff").read_text(encoding="utf-8"):
        raise ReleaseError(f"CITATION.cff does not name version {version}")
    if _IMAGE.findall((root / _MANIFEST).read_text(encoding="utf-8")) != [version]:
        raise ReleaseError(f"{_MANIFEST} does not name version {version}")


def release(version: str, date: dt.date, root: Path = ROOT) -> list[Path]:
    """Make what is unreleased the section of a version, and name it wherever a version stands.

    Returns:
        The files that were written.

    Raises:
        ReleaseError: this is no version of a release, it has a section already, or nothing is unreleased.
    """
    path = root / "CHANGELOG.md"
    text = path.read_text(encoding="utf-8")
    known = sections(text)
    if not is_release(version):
        raise ReleaseError(f"{version} is no version of a release, such as 0.2.0 or 0.2.0rc1")
    if version in known:
        raise ReleaseError(f"CHANGELOG.md has a section for {version} already")
    if not known.get(UNRELEASED):
        raise ReleaseError("CHANGELOG.md: nothing is unreleased")
    heading = f"## {UNRELEASED}"
    path.write_text(text.replace(heading, f"{heading}\n\n## {version} ({date})", 1), encoding="utf-8")
    citation, manifest = root / "CITATION.cff", root / _MANIFEST
    cited = _CITED.sub("", citation.read_text(encoding="utf-8"))
    citation.write_text(f"{cited}version: {version}\ndate-released: '{date}'\n", encoding="utf-8")
    manifest.write_text(_IMAGE.sub(version, manifest.read_text(encoding="utf-8")), encoding="utf-8")
    return [path, citation, manifest]


@click.command(help=__doc__)
@click.argument("version")
@click.option("--release", "write", is_flag=True, help="Make what is unreleased this version, of today.")
def main(version: str, *, write: bool) -> None:
    """Print a section, or make one."""
    try:
        if write:
            files = release(version, dt.datetime.now(dt.UTC).date())
            click.echo(f"written: {', '.join(str(one.relative_to(ROOT)) for one in files)}")
            click.echo(f"next: make check test, commit, git tag -a v{version} -m {version}, make dist installed")
            return
        click.echo(section(version))
    except ReleaseError as error:
        raise click.ClickException(str(error)) from None


if __name__ == "__main__":
    main()
