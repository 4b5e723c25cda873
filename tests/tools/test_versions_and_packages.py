"""A version comes from a tag, a release has a section in CHANGELOG.md, and a wheel holds what git knows."""

import datetime as dt
import io
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from tools.changelog import ROOT, ReleaseError, check_ready, release, section, sections
from tools.dist import _files_of_packages, _stays, check_contents, check_same, repack, sha256

FILES = ("pyproject.toml", "CHANGELOG.md", "CITATION.cff", "deploy/kubernetes/overlays/production/kustomization.yaml")
PLAIN = "# Changelog\n\n## Unreleased\n\n- **new**: a thing\n\n## 0.1.0 (2026-01-31)\n\n- first\n"


def git(folder: Path, *words: str) -> str:
    who = (
        "-c",
        "user.name=t",
        "-c",
        "user.email=t@example.org",
        "-c",
        "commit.gpgsign=false",
        "-c",
        "tag.gpgsign=false",
    )
    return subprocess.run(["git", *who, *words], cwd=folder, capture_output=True, text=True, check=True).stdout.strip()


def version_of(folder: Path) -> str:
    asked = subprocess.run(
        [sys.executable, "-m", "setuptools_scm", "--root", str(folder)], cwd=folder, capture_output=True, text=True
    )
    assert asked.returncode == 0, asked.stderr
    return asked.stdout.splitlines()[-1]


def checkout(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / name)
    return folder


def test_the_version_is_that_of_the_tag(tmp_path: Path) -> None:
    folder = checkout(tmp_path / "repository", "pyproject.toml", ".gitattributes", ".git_archival.txt")
    assert version_of(folder) == "0.1.dev0", "no git, nothing that tells it"
    git(folder, "init", "-q")
    git(folder, "add", "-A")
    git(folder, "commit", "-qm", "first")
    assert version_of(folder).startswith("0.1.dev1+g"), "no tag yet"
    git(folder, "tag", "-a", "v0.2.0", "-m", "0.2.0")
    assert version_of(folder) == "0.2.0"
    archive = tmp_path / "archive.tar"
    git(folder, "archive", "-o", str(archive), "HEAD")
    with tarfile.open(archive) as tar:
        tar.extractall(tmp_path / "unpacked", filter="data")
    assert version_of(tmp_path / "unpacked") == "0.2.0", "an archive of git has no git"
    (folder / "more").write_text("more")
    git(folder, "add", "-A")
    git(folder, "commit", "-qm", "second")
    assert version_of(folder) == f"0.2.1.dev1+g{git(folder, 'rev-parse', '--short=9', 'HEAD')}"


def test_the_changelog_has_sections_by_version() -> None:
    known = sections((ROOT / "CHANGELOG.md").read_text())
    assert next(iter(known)) == "Unreleased"
    assert sections(PLAIN) == {"Unreleased": "- **new**: a thing", "0.1.0": "- first"}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (PLAIN + "\n## 0.1.0 (2026-02-01)\n\n- again\n", "two sections are called 0.1.0"),
        (PLAIN.replace(" (2026-01-31)", ""), "a heading is"),
        (PLAIN.replace("0.1.0", "soon"), "a heading is"),
        (PLAIN.replace("- first\n", ""), "the section of 0.1.0 is empty"),
    ],
)
def test_a_wrong_changelog_is_refused(text: str, says: str) -> None:
    with pytest.raises(ReleaseError, match=says):
        sections(text)


def test_a_release_without_its_section_is_refused_until_it_is_made(tmp_path: Path) -> None:
    folder = checkout(tmp_path, *FILES)
    check_ready("0.1.dev12+g1234567", folder)
    with pytest.raises(ReleaseError, match=r"CHANGELOG.md has no section for 7\.1\.0"):
        check_ready("7.1.0", folder)
    unreleased = section("Unreleased", folder)
    assert len(release("7.1.0", dt.date(2026, 12, 24), folder)) == 3
    check_ready("7.1.0", folder)
    assert (section("7.1.0", folder), section("Unreleased", folder)) == (unreleased, "")
    citation = folder / "CITATION.cff"
    assert citation.read_text().endswith("\nversion: 7.1.0\ndate-released: '2026-12-24'\n")
    with pytest.raises(ReleaseError, match="nothing is unreleased"):
        release("7.1.1", dt.date(2026, 12, 25), folder)
    with pytest.raises(ReleaseError, match=r"section for 7\.1\.0 already"):
        release("7.1.0", dt.date(2026, 12, 25), folder)
    with pytest.raises(ReleaseError, match="no version of a release"):
        release("7.2", dt.date(2026, 12, 25), folder)
    citation.write_text(citation.read_text().replace("7.1.0", "7.0.9"))
    with pytest.raises(ReleaseError, match=r"CITATION\.cff does not name version"):
        check_ready("7.1.0", folder)


def test_a_second_release_takes_the_place_of_the_first_in_the_citation(tmp_path: Path) -> None:
    folder = checkout(tmp_path, *FILES)
    release("7.1.0", dt.date(2026, 12, 24), folder)
    log = folder / "CHANGELOG.md"
    log.write_text(log.read_text().replace("## Unreleased\n", "## Unreleased\n\n- more\n", 1))
    release("7.2.0rc1", dt.date(2027, 1, 2), folder)
    assert list(sections(log.read_text()))[:3] == ["Unreleased", "7.2.0rc1", "7.1.0"]
    assert (folder / "CITATION.cff").read_text().count("version: ") == 2  # the other is the format's
    assert "newTag: 7.2.0rc1}" in (folder / FILES[-1]).read_text()


def packed(path: Path, mtime: int, owner: str, names: tuple[str, ...]) -> Path:
    with tarfile.open(path, "w:gz") as tar:
        for name in names:
            member = tarfile.TarInfo(name)
            member.size, member.mtime, member.uname, member.mode = len(name), mtime, owner, 0o664
            tar.addfile(member, io.BytesIO(name.encode()))
    return path


def test_an_archive_packed_anew_tells_nothing_of_the_machine(tmp_path: Path) -> None:
    one = packed(tmp_path / "one.tar.gz", 1_700_000_000, "ada", ("p/a", "p/b"))
    other = packed(tmp_path / "other.tar.gz", 1_800_000_000, "bob", ("p/b", "p/a"))
    assert sha256(one) != sha256(other)
    for source in (one, other):
        repack(source, tmp_path / f"new-{source.name}", 1_600_000_000)
    assert sha256(tmp_path / "new-one.tar.gz") == sha256(tmp_path / "new-other.tar.gz")
    with tarfile.open(tmp_path / "new-one.tar.gz") as tar:
        found = {member.name: (member.mtime, member.uname, member.mode) for member in tar}
    assert found == dict.fromkeys(("p/a", "p/b"), (1_600_000_000, "", 0o644))
    with pytest.raises(ReleaseError, match=r"new-one.tar.gz: another .* when built again"):
        check_same(lambda _: (one,), (tmp_path / "new-one.tar.gz",))  # type: ignore[arg-type,return-value]


def test_a_wheel_must_hold_what_git_knows_and_nothing_else(tmp_path: Path) -> None:
    wanted = {name: path for name, path in _files_of_packages(ROOT).items() if not _stays(path, ROOT)}
    needed = {
        "gnd/deploy/serve/page/page.js", "gnd/deploy/fleet.toml", "gnd/deploy/links.toml",
        "gnd/deploy/chaos/street.bin", "gnd/deploy/status/alert_rules.template.yaml", "gnd/tile_store/sql/sqlite.sql",
        "gnd/gnd_map/codec/priors.bin",
        "gnd/vehicle_agent/detect/shape_change.json", "gnd/schemas/tile_blob.proto", "gnd/py.typed", "gnd/__init__.py",
    }  # fmt: skip
    assert needed <= wanted.keys()
    assert not any("Dockerfile" in name or "kubernetes" in name for name in wanted)

    def wheel(files: dict[str, bytes]) -> Path:
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.whl"
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in files.items():
                archive.writestr(name, content)
        return path

    files = {name: path.read_bytes() for name, path in wanted.items()}
    assert check_contents(wheel(files | {"gnd_fleet-1.dist-info/RECORD": b""})) == len(files) > 900
    with pytest.raises(ReleaseError, match=r"1 files not in the wheel: gnd/deploy/serve/page/page\.js"):
        check_contents(wheel({name: body for name, body in files.items() if not name.endswith("page.js")}))
    with pytest.raises(ReleaseError, match=r"1 files not known to git: gnd/secret\.key"):
        check_contents(wheel(files | {"gnd/secret.key": b"x"}))
    with pytest.raises(ReleaseError, match=r"1 files not as in git: gnd/deploy/fleet\.toml"):
        check_contents(wheel(files | {"gnd/deploy/fleet.toml": b"x"}))
