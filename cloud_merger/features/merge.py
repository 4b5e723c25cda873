"""The cloud merge of a tile of a feature layer as a pure function (NFL, section 4; SLAMCU, section 4.2).

Each report's features are associated with what is known so far, one-to-one, by distance and covariance, and update it
by recursive least squares; existence is fused over vehicles. The result depends on the epoch's features and on the set
of all reports since, in the order of their ids, and on nothing else: in whatever batches and retries they came, the
same reports give the same features, bit for bit.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from cloud_merger.features.existence import add_views
from cloud_merger.features.parameters import FeatureMergeParameters
from cloud_merger.features.publication import Outcome, outcome_of
from cloud_merger.features.refuted import heard, left_out, refuted_of, tests_of
from cloud_merger.features.spread import spread
from cloud_merger.features.statements import Statement, contents_of, statements_of
from cloud_merger.features.tracks import Bases, Track, Tracks
from gnd_map.features import Feature, FeatureTile
from gnd_map.tile_id import TileId
from schemas.features import FeatureReport
from tile_store.values import ShiftTest


@dataclass(frozen=True, slots=True)
class MergedFeatures:
    """A merged tile of a feature layer.

    Attributes:
        features: what is to be published, snapped and sorted: the epoch's with the decided changes.
        estimates: all hypotheses with all that is known now, published or not (candidates of one vehicle too), sorted
            by id and part.
        provenance: for each feature that differs from the epoch's by decision the ids of the reports that say so.
        tests: of each report that others can be compared with, whether they contradict it; sorted by report id.
    """

    features: tuple[Feature, ...]
    estimates: tuple[Feature, ...]
    provenance: dict[int, tuple[str, ...]]
    tests: tuple[ShiftTest, ...] = ()


def merge_features(
    tile: TileId,
    epoch: Sequence[Feature],
    reports: Iterable[FeatureReport],
    parameters: FeatureMergeParameters | None = None,
    bases: Mapping[bytes, Sequence[Feature]] | None = None,
    refuted: Mapping[str, str] = MappingProxyType({}),
) -> MergedFeatures:
    """Decide what the reports change in the features of a tile.

    Args:
        tile: whose features; frames are its own.
        epoch: the tile's features at its last base or rollback, () for an unmapped one.
        reports: all since the epoch, in any order; of each the part about this tile, and what was found in its
            neighbours near it, count. Reports that come again are ignored.
        parameters: see `FeatureMergeParameters`.
        bases: the features of the versions that reports refer to, by hash. The epoch's and "none" need not be given; a
            report about an unknown version says nothing of features that it does not name.
        refuted: reports that others contradict again and again, and whose each is (`refuted.py`): they are compared as
            all are, and say nothing.
    """
    parameters = parameters or FeatureMergeParameters()
    own = FeatureTile.of(tile, 0, epoch)
    contents = contents_of({b"": (), own.sha: own.features, **(bases or {})})
    reports = list(reports)
    said = statements_of(tile, reports, parameters.reach_m)
    tracks = _tracks_of(tile, epoch, said, contents, parameters)
    tests = tests_of(heard(tracks.all), said, {one.report_id: one.last_ns for one in reports})
    if out := left_out(said, tests, refuted):
        said = tuple(one for one in said if one.report_id not in out)
        tracks = _tracks_of(tile, epoch, said, contents, parameters)
    outcomes = [(track, outcome) for track in tracks.all if (outcome := outcome_of(tile, track, parameters))]
    return MergedFeatures(
        features=FeatureTile.of(tile, 0, [o.published for _, o in outcomes if o.published is not None]).features,
        estimates=tuple(sorted((o.estimate for _, o in outcomes), key=lambda feature: feature.key)),
        provenance=_provenance(outcomes, [one.report_id for one in said]),
        tests=tests,
    )


def _tracks_of(
    tile: TileId,
    epoch: Sequence[Feature],
    said: Sequence[Statement],
    contents: Bases,
    parameters: FeatureMergeParameters,
) -> Tracks:
    tracks = Tracks(epoch, contents, parameters)
    for number, statement in enumerate(said):
        tracks.hear(number, statement)
    tracks.settle()
    add_views(tile, tracks, said, contents, parameters)
    return tracks


def _provenance(outcomes: Iterable[tuple[Track, Outcome]], ids: Sequence[str]) -> dict[int, tuple[str, ...]]:
    found: dict[int, set[str]] = {}
    for track, outcome in outcomes:
        if outcome.published is not track.epoch:
            found.setdefault(track.feature_id, set()).update(ids[number] for number in outcome.reports)
    return {feature_id: tuple(sorted(reports)) for feature_id, reports in sorted(found.items())}


def merge_layer(
    epochs: Mapping[TileId, Sequence[Feature]],
    reports: Iterable[FeatureReport],
    parameters: FeatureMergeParameters | None = None,
) -> dict[TileId, MergedFeatures]:
    """Merge a whole layer, tile by tile, as the cloud would: for studies that have neither store nor bus.

    Args:
        epochs: features of the map's tiles; a tile that is not there is unmapped.
        reports: about any tiles.
        parameters: see `FeatureMergeParameters`.

    Returns:
        Every tile of which the map or a report says something.
    """
    parameters = parameters or FeatureMergeParameters()
    parts: dict[TileId, list[FeatureReport]] = {tile: [] for tile in epochs}
    for report in reports:
        for tile, part in spread(report, parameters.reach_m).items():
            parts.setdefault(tile, []).append(part)
    merged = {tile: merge_features(tile, epochs.get(tile, ()), parts[tile], parameters) for tile in sorted(parts)}
    refuted = refuted_of(test for one in merged.values() for test in one.tests)
    again = {tile for tile, said in parts.items() if any(one.vehicle in refuted.values() for one in said)}
    return {
        tile: merge_features(tile, epochs.get(tile, ()), parts[tile], parameters, refuted=refuted)
        if tile in again
        else one
        for tile, one in merged.items()
    }
