"""The feature layers of a fleet run: laid into its store before it starts, compared with the truth after it."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from gnd.fleet_sim.feature_files import read_feature_layers
from gnd.fleet_sim.feature_scores import FeatureScore, score_features, tiles_of_one_drive
from gnd.fleet_sim.feature_truth import FeatureTruth, feature_truth
from gnd.fleet_sim.world import read_world
from gnd.gnd_map.features import Feature, FeatureTile, feature_id_of
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.features import FeatureReport
from gnd.tile_store.sqlite_store import SqliteStore, SqlStore
from gnd.words import many


def put_base_layers(store: Path, features: Path, layers: Sequence[str]) -> None:
    """Put the feature layers of the map before into the store of a run.

    Args:
        store: the store.
        features: file of the simulated world's layers.
        layers: only these; a layer that the map has not begins empty.
    """
    known = read_feature_layers(features)
    with SqliteStore(store) as opened:
        for layer in layers:
            if known.get(layer):
                opened.put_tiles(known[layer], layer=layer)


def score_layers(world: Path, store: SqlStore, layers: Sequence[str]) -> dict[str, Any]:
    """Compare feature layers with the truth: the map before, each drive alone, the map after.

    Args:
        world: file of the simulated world.
        store: of the finished run.
        layers: to be compared.

    Returns:
        By layer: accuracy in percent of normal, deleted, new and all features (SLAMCU, Table 1) by stage, false new
        ones, and the error of the places of new features in metres.
    """
    truth = feature_truth(read_world(world))
    return {layer: _score(truth, store, layer) for layer in layers}


def _score(truth: FeatureTruth, store: SqlStore, layer: str) -> dict[str, Any]:
    before, after = base_tiles(store, layer), newest_tiles(store, layer)
    alone = [score_features(truth, layer, tiles) for tiles in tiles_of_vehicles(store, layer, before).values()]
    stages = {"before": [score_features(truth, layer, before)], "single": alone}
    stages["after"] = [score_features(truth, layer, after)]
    told = {name: _stage(scores) for name, scores in stages.items()}
    return told | {"truth": dict(stages["after"][0].truth), "features": sum(len(tile.features) for tile in after)}


def _stage(scores: Sequence[FeatureScore]) -> dict[str, float | None]:
    """The mean of some scores of one stage."""
    rows = [_row(score) for score in scores]
    return {name: _mean(row[name] for row in rows) for name in rows[0]} if rows else {}


def _row(score: FeatureScore) -> dict[str, float | None]:
    shares = {str(name): _percent(one.right, one.right + one.missed) for name, one in score.classes.items()}
    right = sum(one.right for one in score.classes.values())
    there = sum(one.right + one.missed for one in score.classes.values())
    error_m = round(score.mean_error_m, 4) if score.error_m else None
    return {**shares, "all": _percent(right, there), "false": score.classes["new"].wrong, "new_error_m": error_m}


def _percent(part: int, whole: int) -> float | None:
    return round(100.0 * part / whole, 2) if whole else None


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return round(fmean(known), 4) if known else None


def base_tiles(store: SqlStore, layer: str) -> list[FeatureTile]:
    """Return the tiles of a layer as they were before anything was merged."""
    return [tile for entry in store.heads(layer) if (tile := _at_epoch(store, layer, entry.tile)) is not None]


def newest_tiles(store: SqlStore, layer: str) -> list[FeatureTile]:
    """Return the tiles of a layer as they are now."""
    return [tile for entry in store.heads(layer) if (tile := _decoded(store, layer, entry.tile, None)) is not None]


def _at_epoch(store: SqlStore, layer: str, tile_id: TileId) -> FeatureTile | None:
    epochs = [info.version for info in store.history(layer, tile_id) if info.kind != "merged"]
    return _decoded(store, layer, tile_id, epochs[-1]) if epochs else None


def _decoded(store: SqlStore, layer: str, tile_id: TileId, version: int | None) -> FeatureTile | None:
    stored = store.get(layer, tile_id, version)
    return None if stored is None else stored.decode_features()


def tiles_of_vehicles(store: SqlStore, layer: str, before: Sequence[FeatureTile]) -> dict[str, tuple[FeatureTile, ...]]:
    """Return for each vehicle the layer as its own reports alone would have it."""
    absent: dict[str, set[int]] = defaultdict(set)
    found: dict[str, dict[TileId, list[Feature]]] = defaultdict(lambda: defaultdict(list))
    for row in store.reports(layer):
        for change in (one for one in FeatureReport.decode(row.body).tiles if one.tile == row.tile):
            absent[row.vehicle] |= {one.feature_id for one in change.seen if one.existence.state == "absent"}
            for number, one in enumerate(change.found):
                feature_id = feature_id_of(row.report_id, change.tile.morton, number)
                found[row.vehicle][change.tile].append(one.as_feature(feature_id))
    vehicles = sorted({*absent, *found})
    return {vehicle: tiles_of_one_drive(before, absent[vehicle], found[vehicle]) for vehicle in vehicles}


def feature_lines(features: dict[str, Any]) -> list[str]:
    """Return the scores of layers as lines for people."""
    return [_line(layer, told) for layer, told in features.items() if told.get("after")]


def _line(layer: str, told: dict[str, Any]) -> str:
    stages = ", ".join(f"{_text(told[stage].get('all'))} % {word}" for stage, word in _STAGES if told.get(stage))
    after = told["after"]
    error = "" if after["new_error_m"] is None else f", new ones {after['new_error_m'] * 100:.1f} cm off"
    return f"layer {layer}: {many(told['features'], 'feature')}; of all changes and what stayed, right: {stages}{error}"


_STAGES = (("before", "before"), ("single", "by a single drive"), ("after", "after"))


def _text(value: float | None) -> str:
    return "–" if value is None else f"{value:.1f}"
