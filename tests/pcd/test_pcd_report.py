import numpy as np
import pytest

from studies.pcd import PcdError, PcdMap, PcdReport


def test_bytes_are_those_of_the_points_and_indices(cloud, reports):
    r = reports[0]
    size = r.sizes(cloud)
    assert size["points"] - size["indexed"] == 8 * len(r.deleted_index)
    bare = PcdReport(r.new_points[:0], r.deleted_index[:0], r.observed, r.map_size).sizes(cloud)
    assert size["points"] - bare["points"] == 12 * (len(r.new_points) + len(r.deleted_index))
    assert 3 * (len(r.new_points) + len(r.deleted_index)) < size["compact"] < size["indexed"] / 2


def test_numbers_out_of_order_are_refused(cloud):
    empty, nothing = np.empty((0, 3), np.float32), np.empty(0, np.int32)
    with pytest.raises(PcdError, match="increase"):
        PcdReport(empty, np.array([3, 3], np.int32), nothing, 10)
    with pytest.raises(PcdError, match="increase"):
        PcdReport(empty, np.array([10], np.int32), nothing, 10)


def test_a_report_about_another_map_is_refused(cloud, reports):
    with pytest.raises(PcdError, match=str(len(cloud) - 1)):
        reports[0].sizes(PcdMap(cloud.points_m[:-1], cloud.frame))
