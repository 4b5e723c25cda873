from pathlib import Path

import numpy as np
import pytest
from sklearn.metrics import confusion_matrix, f1_score, precision_score, recall_score

from gnd.fleet_sim.errors import EvaluationError
from gnd.fleet_sim.evaluate import CLASSES, classes_of_maps, evaluate, evaluate_maps
from gnd.fleet_sim.truth import LEVELS, Truth
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians, concat
from gnd.gnd_map.tile_id import TileId


def perfect_map(edited: Truth) -> dict[TileId, Gaussians]:
    """The base map with every true change made, and nothing else touched."""
    found = {}
    for tile in set(edited.before) | set(edited.after):
        old, new = (state.get(tile, Gaussians.empty()) for state in (edited.before, edited.after))
        inside = edited.morton == tile.morton
        of = {c: edited.voxel_id[inside & (edited.change_class == c)] for c in CLASSES}
        kept = old.take(np.isin(old.voxel_id, of[ChangeClass.NORMAL]))
        changed = np.concatenate([of[ChangeClass.NEW], of[ChangeClass.MODIFIED]])
        found[tile] = concat([kept, new.select(changed)])
    return found


def test_scores_agree_with_scikit_learn(edited: Truth) -> None:
    rng = np.random.default_rng(0)
    wrong = rng.random(len(edited)) < 0.1
    predicted = np.where(wrong, rng.integers(0, 5, len(edited)), edited.change_class).astype(np.uint8)
    evaluation = evaluate(edited, predicted)
    labels = [int(c) for c in CLASSES]
    for level in LEVELS:
        mask = edited.mask(level)
        pair = edited.change_class[mask], predicted[mask]
        score = evaluation.scores[level]
        np.testing.assert_array_equal(score.confusion, confusion_matrix(*pair, labels=labels))
        options = {"labels": labels, "average": None, "zero_division": 0}
        for name, oracle in (("precision", precision_score), ("recall", recall_score), ("f1", f1_score)):
            ours = [getattr(s, name) for s in score.classes.values()]
            np.testing.assert_allclose(ours, 100 * oracle(*pair, **options), atol=1e-9)
        assert score.macro_f1 == pytest.approx(100 * f1_score(*pair, labels=labels, average="macro", zero_division=0))
        assert evaluation.f1(level) == score.macro_f1


def test_the_perfect_map_scores_100_at_every_level(edited: Truth) -> None:
    evaluation = evaluate_maps(edited, edited.before, perfect_map(edited))
    assert [evaluation.f1(level) for level in LEVELS] == [pytest.approx(100.0)] * 3
    np.testing.assert_array_equal(evaluation.predicted, edited.change_class)


def test_the_stale_map_knows_only_normal_and_empty(edited: Truth) -> None:
    evaluation = evaluate_maps(edited, edited.before, edited.before)
    assert set(np.unique(evaluation.predicted)) == {ChangeClass.NORMAL, ChangeClass.EMPTY}
    for level in LEVELS:
        scores = evaluation.scores[level].classes
        assert [scores[name].f1 for name in ("new", "modified", "deleted")] == [0.0, 0.0, 0.0]
        assert 20.0 < evaluation.f1(level) < 40.0


def test_no_map_at_all_is_scored_too(edited: Truth) -> None:
    evaluation = evaluate_maps(edited, {}, {})
    assert evaluation.scores["all"].classes["normal"].recall == 0.0
    assert evaluation.scores["all"].classes["empty"].recall == 100.0


def test_classes_of_two_maps_follow_from_what_each_holds(edited: Truth) -> None:
    tile = max(edited.before, key=lambda t: len(edited.before[t]))
    old = edited.before[tile]
    inside = old.take(np.isin(old.voxel_id, edited.voxel_id[edited.morton == tile.morton]))
    gone, changed, rest = inside.voxel_id[:3], inside.voxel_id[3:5], inside.voxel_id[5:]
    touched = inside.take(np.isin(inside.voxel_id, changed))
    touched = Gaussians(touched.voxel_id, touched.count + 1, touched.cells, touched.mean_m, touched.cov_m2)
    new = concat([inside.take(np.isin(inside.voxel_id, rest)), touched])
    predicted = classes_of_maps(edited, {tile: inside}, {tile: new})
    back = classes_of_maps(edited, {tile: new}, {tile: inside})

    def at(classes: np.ndarray, ids: np.ndarray) -> set[int]:
        return set(classes[(edited.morton == tile.morton) & np.isin(edited.voxel_id, ids)].tolist())

    assert at(predicted, gone) == {ChangeClass.DELETED}
    assert at(predicted, changed) == {ChangeClass.MODIFIED}
    assert at(predicted, rest) == {ChangeClass.NORMAL}
    assert at(back, gone) == {ChangeClass.NEW}


def test_a_prediction_of_the_wrong_size_or_with_a_sixth_class_is_refused(edited: Truth) -> None:
    with pytest.raises(EvaluationError, match=f"{len(edited)} voxels"):
        evaluate(edited, np.zeros(3, np.uint8))
    with pytest.raises(EvaluationError, match="class 5"):
        evaluate(edited, np.full(len(edited), 5, np.uint8))


def test_scores_become_plain_numbers(edited: Truth) -> None:
    found = evaluate_maps(edited, edited.before, edited.before).as_dict()
    assert set(found) == set(LEVELS)
    assert set(found["scored"]["classes"]) == {"normal", "new", "modified", "deleted", "empty"}
    assert sum(map(sum, found["all"]["confusion"])) == len(edited)


@pytest.mark.slow
def test_the_stale_map_of_the_street_scores_as_in_the_paper(truth_1: tuple[Truth, Path]) -> None:
    """37.36 % in the paper (section 6.3): a property of the world, not a target; here it is of the same kind."""
    truth = truth_1[0]
    assert 35.0 < evaluate_maps(truth, truth.before, truth.before).f1("all") < 40.0
