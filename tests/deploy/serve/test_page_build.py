"""The built page is what its sources give, is small, and its colours differ also for those who see fewer."""

import gzip
import itertools
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "page"
BUILT = ROOT / "deploy" / "serve" / "page"
FILES = ("index.html", "page.js", "page.css", "icon.svg")
PALETTE = json.loads((PAGE / "src" / "palette.json").read_text(encoding="utf-8"))

# Machado, Oliveira, Fernandes 2009: how linear RGB looks without one kind of cone.
SIGHT = {
    "usual": np.eye(3),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
WHITE = np.array([0.95047, 1.0, 1.08883])


def lab(colour: str, sight: str) -> np.ndarray:
    """CIE L*a*b* of a colour as somebody sees it."""
    rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    xyz = TO_XYZ @ np.clip(SIGHT[sight] @ linear, 0.0, 1.0) / WHITE
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize("sight", SIGHT)
@pytest.mark.parametrize("group", ["change", "surface", "health"])
def test_any_two_colours_of_a_legend_differ_by_thirty(group: str, sight: str) -> None:
    seen = {name: lab(colour, sight) for name, colour in PALETTE[group].items()}
    apart = {(a, b): float(np.linalg.norm(seen[a] - seen[b])) for a, b in itertools.combinations(seen, 2)}
    assert min(apart.values()) > 30, apart


@pytest.mark.parametrize("sight", SIGHT)
def test_the_ramp_grows_lighter_all_the_way(sight: str) -> None:
    lightness = [lab(colour, sight)[0] for colour in PALETTE["ramp"]]
    assert all(b > a for a, b in itertools.pairwise(lightness))


def test_the_built_page_is_what_its_sources_give() -> None:
    if shutil.which("node") is None or not (PAGE / "node_modules" / "esbuild").is_dir():
        pytest.skip("node, or what page/package-lock.json names, is not installed: `make page`")
    done = subprocess.run(["node", "build.mjs", "--check"], cwd=PAGE, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def test_the_page_is_small_and_asks_nobody_else() -> None:
    sizes = {name: len(gzip.compress((BUILT / name).read_bytes(), 9)) for name in FILES}
    assert sum(sizes.values()) < 800_000, sizes
    assert sorted(path.name for path in BUILT.iterdir()) == sorted(FILES)
    style = (BUILT / "page.css").read_text(encoding="utf-8")
    assert "url(" not in style
    assert "@import" not in style
    script = (BUILT / "page.js").read_text(encoding="utf-8")
    called = re.findall(r"\b(?:fetch|WebSocket|EventSource|importScripts)\(", script)
    assert called
    assert not re.search(r"fetch\(\s*[\"']https?:", script)
    assert "innerHTML" not in (text := "".join(path.read_text() for path in (PAGE / "src").glob("*.ts")))
    assert "insertAdjacentHTML" not in text


def test_the_lock_names_every_package_by_its_hash_and_no_address() -> None:
    lock = json.loads((PAGE / "package-lock.json").read_text(encoding="utf-8"))
    packages = {name: one for name, one in lock["packages"].items() if name}
    assert all(one["integrity"].startswith("sha512-") for one in packages.values())
    assert not any("resolved" in one for one in packages.values())
    asked = json.loads((PAGE / "package.json").read_text(encoding="utf-8"))
    assert all(
        re.fullmatch(r"[0-9.]+", one) for one in (*asked["dependencies"].values(), *asked["devDependencies"].values())
    )
