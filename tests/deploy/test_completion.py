"""`gnd completion` in the real shells, where they are installed."""

import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

LOADER = Path("/usr/share/bash-completion/bash_completion")


@pytest.fixture
def home(tmp_path: Path) -> dict[str, str]:
    """The environment of a user with a `gnd` of this checkout."""
    (tmp_path / "bin").mkdir()
    program = tmp_path / "bin" / "gnd"
    program.write_text(
        f"#!{sys.executable}\nimport sys\nsys.argv[0] = 'gnd'\nfrom gnd.program import program\nprogram()\n"
    )
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    kept = {name: value for name, value in os.environ.items() if not name.startswith("XDG_")}
    return kept | {"HOME": str(tmp_path), "PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}", "TERM": "dumb"}


def ran(words: list[str], home: dict[str, str]) -> str:
    if shutil.which(words[0]) is None and words[0] != "gnd":
        pytest.skip(f"{words[0]} is not installed")
    words = [f"{home['HOME']}/bin/gnd", *words[1:]] if words[0] == "gnd" else words
    done = subprocess.run(words, env=home, cwd=home["HOME"], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def in_bash(line: str, home: dict[str, str], *before: str) -> list[str]:
    """What Tab offers at the end of a line."""
    words = line.split(" ")
    script = "; ".join(
        [*before, f"COMP_WORDS=({' '.join(words)} {'' if words[-1] else chr(39) * 2})", f"COMP_CWORD={len(words) - 1}"]
    )
    return ran(
        ["bash", "--norc", "-c", f'{script}; _gnd_completion gnd; printf "%s\\n" "${{COMPREPLY[@]}}"'], home
    ).split()


def test_bash_completes_commands_options_and_values(home: dict[str, str]) -> None:
    source = 'eval "$(gnd completion bash)"'
    assert in_bash("gnd sta", home, source) == ["status"]
    assert {"--watch", "--check", "--json"} <= set(in_bash("gnd status --", home, source))
    assert in_bash("gnd map rest", home, source) == ["restore"]


def test_an_installed_completion_is_found_by_the_shell(home: dict[str, str]) -> None:
    said = ran(["gnd", "completion", "bash", "--install"], home)
    path = Path(home["HOME"]) / ".local/share/bash-completion/completions/gnd"
    assert str(path) in said
    again = path.read_text()
    ran(["gnd", "completion", "bash", "--install"], home)  # twice is once
    assert path.read_text() == again
    if LOADER.exists():
        script = f". {LOADER}; _completion_loader gnd; complete -p gnd"
        assert "_gnd_completion" in ran(["bash", "--norc", "-c", script], home)
    path.write_text("of somebody else\n")
    words = [f"{home['HOME']}/bin/gnd", "completion", "bash", "--install"]
    refused = subprocess.run(words, env=home, capture_output=True, text=True, timeout=120)
    assert (refused.returncode, path.read_text()) == (2, "of somebody else\n")
    assert "not ours" in refused.stderr


def test_fish_completes_after_the_installation(home: dict[str, str]) -> None:
    ran(["gnd", "completion", "fish", "--install"], home)
    offered = ran(["fish", "-c", "complete -C 'gnd sta'"], home)
    assert [line.split("\t")[0] for line in offered.splitlines()] == ["status"]


def test_zsh_finds_the_installed_function_and_gets_its_answers(home: dict[str, str]) -> None:
    ran(["gnd", "completion", "zsh", "--install"], home)
    folder = Path(home["HOME"]) / ".local/share/zsh/site-functions"
    found = ran(
        ["zsh", "-f", "-c", f"fpath=({folder} $fpath); autoload -U compinit; compinit -u; print $_comps[gnd]"], home
    )
    assert found.strip() == "_gnd"
    asked = home | {"_GND_COMPLETE": "zsh_complete", "COMP_WORDS": "gnd sta", "COMP_CWORD": "1"}
    assert ran(["gnd"], asked).splitlines()[:2] == ["plain", "status"]
