import numpy as np
import pytest

from gnd.fleet_sim.evaluate import Score
from gnd.gnd_map.classes import ChangeClass
from gnd.vehicle_agent.detect.parameters import DetectParameters
from studies.simulation.losses import (
    EDGE,
    FEW_CELLS,
    FEW_RAYS,
    RIGHT,
    UNSEEN,
    Loss,
    _gain,
    _pattern,
    causes,
    columns_at,
    mean_losses,
)
from studies.simulation.result import EVIDENCE, VehicleResult
from studies.simulation.scores import mean_of

N, A, M, D, E, U = (int(c) for c in ChangeClass)


def evidence(**columns: int) -> dict[str, np.ndarray]:
    values = dict.fromkeys(EVIDENCE, 0) | {"seen": 1} | columns
    return {name: np.array([value], np.int32) for name, value in values.items()}


@pytest.mark.parametrize(
    ("true", "columns", "cause"),
    [
        (D, {"seen": 0, "change_class": U}, UNSEEN),
        (D, {"change_class": D}, RIGHT),
        (A, {"change_class": U, "cells": 12}, FEW_CELLS),
        (D, {"change_class": U, "map_cells": 60, "n_pi": 1}, FEW_RAYS),
        (A, {"change_class": E, "cells": 3}, "empty: too few sub-cells met"),
        (A, {"change_class": E}, "empty: rays pass, nothing met"),
        (E, {"change_class": A, "cells": 50}, "new: something stood or moved there"),
        (M, {"change_class": N, "cells": 50, "map_cells": 60}, "normal: the Gaussians are too alike"),
        (A, {"change_class": U, "cells": 30}, EDGE),
        (M, {"change_class": N, "cells": 5, "map_cells": 60}, "normal: too few sub-cells for a Gaussian"),
        (N, {"change_class": M, "cells": 25, "map_cells": 60}, "modified: only a part of it seen"),
        (N, {"change_class": M, "cells": 55, "map_cells": 60}, "modified: unlike the map's Gaussian"),
        (N, {"change_class": D, "n_pi": 30, "map_cells": 60}, "deleted: rays pass through what stands"),
        (D, {"change_class": N, "cells": 9, "map_cells": 60}, "normal: points met where it stood"),
    ],
)
def test_causes_follow_from_the_evidence(true: int, columns: dict[str, int], cause: str) -> None:
    assert causes(np.array([true], np.uint8), evidence(**columns), DetectParameters()).tolist() == [cause]


def test_evidence_is_found_by_row() -> None:
    columns = {name: np.array([7, 8], np.int32) for name in EVIDENCE}
    result = VehicleResult("v", "vlp16", (), np.array([3, 9], np.int32), columns, {})
    found = columns_at(result, np.array([2, 3, 9, 50]))
    assert found["seen"].tolist() == [0, 1, 1, 0]
    assert found["cells"].tolist() == [0, 7, 8, 0]
    assert found["change_class"].tolist() == [U, 7, 8, U]


def test_without_evidence_everything_is_unseen() -> None:
    empty = {name: np.zeros(0, np.int32) for name in EVIDENCE}
    found = columns_at(VehicleResult("v", "vlp16", (), np.zeros(0, np.int32), empty, {}), np.array([1, 2]))
    assert found["change_class"].tolist() == [U, U]


@pytest.mark.parametrize(
    ("right", "votes", "pattern"),
    [(0, 0, "nobody decides"), (8, 9, "outvoted in the cloud though most are right"), (5, 9, "votes split"),
     (1, 9, "most say something else")],
)  # fmt: skip
def test_votes_have_patterns(right: int, votes: int, pattern: str) -> None:
    assert _pattern(right, votes, 0.6, {"x"}) == pattern
    assert _pattern(0, 0, 0.6, {UNSEEN}) == "observed by nobody"


def test_the_gain_is_what_macro_f1_would_be_without_the_errors() -> None:
    confusion = np.diag([100, 50, 40, 30, 500]).astype(np.int64)
    assert _gain(confusion, 0, 1, "scored") == 0.0
    confusion[M, N] = 20
    repaired = confusion.copy()
    repaired[M, N], repaired[M, M] = 0, 60
    gain = Score("scored", repaired).macro_f1 - Score("scored", confusion).macro_f1
    assert _gain(confusion, M, N, "scored") == pytest.approx(gain)
    assert gain > 5.0


def test_means_of_losses_count_worlds_without_the_error_as_zero() -> None:
    one = [Loss("new", "empty", 10.0, 2.0, {"a": 6.0, "b": 4.0})]
    (mean,) = mean_losses([one, []])
    assert (mean.voxels, mean.f1, dict(mean.by_cause)) == (5.0, 1.0, {"a": 3.0, "b": 2.0})


def test_means_of_nested_tables() -> None:
    assert mean_of([{"a": {"x": 1.0}, "b": 2}, {"a": {"x": 2.0}, "b": 4}]) == {"a": {"x": 1.5}, "b": 3.0}
    assert mean_of([{"a": 1.0}, {"a": 3.0, "b": 5.0}]) == {"a": 2.0, "b": 5.0}
