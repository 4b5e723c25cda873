import numpy as np
import pytest

from studies.localisation_study.figures import NEAR_M, broken, share_near


def test_the_share_of_what_is_near() -> None:
    p_m = np.array([[0.0, 0.0], [NEAR_M - 1, 0.0], [NEAR_M + 1, 0.0], [0.0, 5.0], [500.0, 0.0]])
    changed = np.array([True, False, True, False, True])
    way_m = np.array([[0.0, 0.0], [500.0, 0.0], [-500.0, 0.0]])
    assert share_near(p_m, changed, way_m) == pytest.approx([1 / 3, 1.0, 0.0])


def test_lines_are_broken_where_poses_are_missing() -> None:
    t_s = np.array([0.0, 0.1, 0.2, 0.3, 1.5, 1.6, 1.7])
    found_s, error = broken(t_s, np.arange(7.0))
    assert np.isnan(found_s).tolist() == np.isnan(error).tolist() == [False] * 4 + [True] + [False] * 3
    assert found_s[~np.isnan(found_s)] == pytest.approx(t_s)
