"""The pictures of the page for the documents, of a run of two vehicles; nothing of the run is changed by it."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gnd.tile_store.sqlite_store import SqliteStore
from studies.frame.browser import WINDOW, chromium
from studies.frame.errors import BrowserError
from tools.page_pictures import MOST_BYTES, PICTURES, take

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(900),
    pytest.mark.skipif(chromium() is None, reason="no chromium is installed"),
]


def versions(run: Path) -> list[int]:
    with SqliteStore(run / "store.sqlite", read_only=True) as store:
        return [line.version for line in store.head_lines("ndt")]


def test_four_pictures_are_taken_and_the_run_stays_as_it_is(finished_run: Path, tmp_path: Path) -> None:
    before = versions(finished_run)
    sizes = take(finished_run, tmp_path / "out")
    assert sorted(sizes) == sorted(path.name for path in (tmp_path / "out").iterdir())
    assert list(sizes) == [one.name for one in PICTURES]
    shown = {}
    for name, size in sizes.items():
        assert size <= MOST_BYTES
        with Image.open(tmp_path / "out" / name) as picture:
            assert picture.width == WINDOW["width"]
            shown[name] = np.asarray(picture.convert("L"), float)
    means = {name: float(grey.mean()) for name, grey in shown.items()}
    assert means["page_light.jpg"] > 120 > max(one for name, one in means.items() if name != "page_light.jpg"), means
    assert min(float(grey[100:600, :900].std()) for grey in shown.values()) > 15, "the map's window is not empty"
    assert versions(finished_run) == before


def test_a_run_in_which_nothing_has_changed_is_refused(small_world: object, tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "store.sqlite").write_bytes(small_world.base_map.read_bytes())  # type: ignore[attr-defined]
    with pytest.raises(BrowserError, match="0 changes and 0 ways"):
        take(run, tmp_path / "out")
