from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.image import imread

from gnd.fleet_sim.ellipsoids import Ellipsoids, ellipsoids_of_maps, ellipsoids_of_truth
from gnd.fleet_sim.errors import SimError
from gnd.fleet_sim.pictures import StreetView, draw_map, draw_run
from gnd.fleet_sim.truth import Truth
from gnd.fleet_sim.world import World
from gnd.gnd_map.classes import ChangeClass
from gnd.picture_style import SAFE_COLOURS


def share_of_hue(path: Path, change_class: ChangeClass) -> float:
    """Share of pixels below the heading whose colour is a lit or shaded version of the class's."""
    pixels = imread(path)[200::2, ::2, :3].reshape(-1, 3)
    wanted = np.array(to_rgb(SAFE_COLOURS[change_class])) - np.mean(to_rgb(SAFE_COLOURS[change_class]))
    hue = pixels - pixels.mean(axis=1, keepdims=True)
    size = np.linalg.norm(hue, axis=1)
    close = hue @ wanted / np.maximum(size * np.linalg.norm(wanted), 1e-9) > 0.97
    return float(np.mean(close & (size > 0.15)))


def test_a_picture_shows_every_class_in_its_colour(edited: Truth, tmp_path: Path) -> None:
    draw_map(ellipsoids_of_truth(edited), tmp_path / "truth.png", "Truth", "a note")
    assert imread(tmp_path / "truth.png").shape == (1260, 1890, 4)
    for change_class in (ChangeClass.NORMAL, ChangeClass.NEW, ChangeClass.MODIFIED, ChangeClass.DELETED):
        assert share_of_hue(tmp_path / "truth.png", change_class) > 2e-4, change_class.name


def test_the_pictures_of_a_run_differ_only_by_what_changed(edited: Truth, tmp_path: Path) -> None:
    before, after, true = draw_run(edited, edited.before, edited.after, tmp_path)
    assert [p.name for p in (before, after, true)] == ["map_before.png", "map_after.png", "truth.png"]
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(["map_before.png", "map_after.png", "truth.png"])
    assert np.mean(imread(before)[200:, :, :3].max(axis=2) < 0.8) > 0.02, "what stayed is grey: it has no hue"
    for change_class in (ChangeClass.NEW, ChangeClass.DELETED):
        assert share_of_hue(before, change_class) < 2e-5 < 2e-4 < share_of_hue(after, change_class)


def test_ellipsoids_stand_where_the_world_was_built(edited: Truth, edited_world: World) -> None:
    e = ellipsoids_of_truth(edited)
    street = edited_world.street_of_map(e.mean_m)
    came = street[(e.change_class == ChangeClass.NEW) & (np.abs(street[:, 1] - 8.1) < 0.5)]
    assert len(came) > 10
    assert np.all((came[:, 0] > 0.5) & (came[:, 0] < 5.5)), "the wall that comes stands at 1 … 5 m"
    went = street[(e.change_class == ChangeClass.DELETED) & (np.abs(street[:, 1] - 8.1) < 0.5)]
    assert np.all((went[:, 0] > -5.5) & (went[:, 0] < -0.5))
    road = (np.abs(street[:, 1]) < 3.0) & (e.change_class == ChangeClass.NORMAL)
    np.testing.assert_allclose(street[road, 2], 0.0, atol=1e-3)
    assert np.linalg.eigvalsh(e.cov_m2[road])[:, 0].max() < 1e-4, "noise-free road is flat"


def test_ellipsoids_of_two_maps_carry_what_became_of_each_voxel(edited: Truth) -> None:
    e = ellipsoids_of_maps(edited.frame, edited.before, edited.after)
    found = np.bincount(e.change_class, minlength=4)
    old, new = (sum(len(g) for g in state.values()) for state in (edited.before, edited.after))
    assert found[ChangeClass.NORMAL] + found[ChangeClass.MODIFIED] + found[ChangeClass.DELETED] == old
    assert found[ChangeClass.NORMAL] + found[ChangeClass.MODIFIED] + found[ChangeClass.NEW] == new
    assert set(ellipsoids_of_maps(edited.frame, edited.before).change_class) == {ChangeClass.NORMAL}


def test_a_long_street_is_drawn_in_rows_that_join(edited: Truth, tmp_path: Path) -> None:
    view = StreetView((3.0, -2.0, 30.0), 0.5, 200.0, 0.0)
    rows = view.rows()
    assert [row.half_length_m for row in rows] == [100.0, 100.0]
    places = (np.array([row.origin_m for row in rows]) - np.array(view.origin_m)) @ view.R_view_map.T
    np.testing.assert_allclose(places, [[-100.0, 0.0, 0.0], [100.0, 0.0, 0.0]], atol=1e-9)
    draw_map(ellipsoids_of_truth(edited), tmp_path / "long.png", "Long", view=view)
    assert imread(tmp_path / "long.png").shape[:2] == (1675, 1890)
    assert [row.half_length_m for row in StreetView((0.0, 0.0, 0.0), 0.0, 500.0, 0.0).rows()] == [125.0] * 4


def test_an_empty_map_can_be_drawn(tmp_path: Path) -> None:
    nothing = Ellipsoids.joined([])
    draw_map(nothing, tmp_path / "empty.png", "Nothing", view=StreetView.around(nothing))
    assert (tmp_path / "empty.png").stat().st_size > 1000


def test_a_picture_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SimError, match="cannot write the picture"):
        draw_map(Ellipsoids.joined([]), tmp_path / "no" / "map.png", "Nothing")
