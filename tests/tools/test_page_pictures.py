"""Where the pictures of the page are taken from, and what is said when they cannot be.

They themselves are tested with a run, in tests/deploy/serve/test_page_pictures_of_run.py.
"""

import io
import math
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from studies.frame.browser import chromium
from tools.page_pictures import FINER, MOST_BYTES, Look, Street, _write, main


def test_a_view_is_told_along_the_street() -> None:
    northwards = Street((10.0, 20.0, 30.0), math.pi / 2)
    target, eye = northwards.place(Look(along_m=5.0, left_m=2.0, far_m=100.0, turn_deg=0.0, tilt_deg=30.0))
    assert target == pytest.approx([8.0, 25.0, 30.0])
    assert eye == pytest.approx([8.0, 25.0 - 100.0 * math.cos(math.pi / 6), 80.0])
    _, from_west = northwards.place(Look(0.0, 0.0, 100.0, turn_deg=90.0, tilt_deg=0.0))
    assert from_west == pytest.approx([-90.0, 20.0, 30.0]), "clockwise of north one looks east"


def test_a_picture_of_noise_gets_fewer_bytes_by_quality(tmp_path: Path) -> None:
    noise = np.random.default_rng(1).integers(0, 255, (FINER * 400, FINER * 640, 3), np.uint8)
    drawn = io.BytesIO()
    Image.fromarray(noise).save(drawn, "PNG")
    assert _write(drawn.getvalue(), tmp_path / "noise.jpg") <= MOST_BYTES
    with Image.open(tmp_path / "noise.jpg") as picture:
        assert (picture.format, picture.size) == ("JPEG", (640, 400))


@pytest.mark.skipif(chromium() is None, reason="no chromium is installed")
def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    done = CliRunner().invoke(main, [str(tmp_path), str(tmp_path / "out")])
    assert done.exit_code == 1
    assert done.output.startswith("Error: ")
    assert str(tmp_path) in done.output
