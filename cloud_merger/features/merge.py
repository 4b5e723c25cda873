"""The cloud merge of a tile of a feature layer as a pure function (NFL, section 4; SLAMCU, section 4.2).

Each report's features are associated with what is known so far, one-to-one, by distance and covariance, and update it
by recursive least squares; existence is fused over vehicles. The result depends on the epoch's features and on the set
of all reports since, in the order of their ids, and on nothing else: in whatever batches and retries they came, the
same reports give the same features, bit for bit.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

from gnd.cloud_merger.features.existence import add_views
from gnd.cloud_merger.features.memory import LayerMemory
from gnd.cloud_merger.features.parameters import FeatureMergeParameters
from gnd.cloud_merger.features.publication import Outcome, Story, story_of
from gnd.cloud_merger.features.refuted import heard, left_out, refuted_of, tests_of
from gnd.cloud_merger.features.spread import spread
from gnd.cloud_merger.features.statements import Statement, contents_of, statements_of
from gnd.cloud_merger.features.tracks import Bases, FeatureTracks
from gnd.gnd_map.features import Feature, FeatureTile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.features import FeatureReport
from gnd.tile_store.values import ShiftTest


@dataclass(frozen=True, slots=True, eq=False)
class Hypotheses:
    """What a window leaves behind: all that is to be folded when it is closed.

    Attributes:
        stories: of all hypotheses, in the order in which they began.
        names: ids under which each track (by `serial`) has been known.
        report_ids: of the statements, then of the witnesses of closed windows: numbers of reports index it.
    """

    stories: tuple[Story, ...]
    names: Mapping[int, Sequence[int]]
    report_ids: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class MergedFeatures:
    """A merged tile of a feature layer.

    Attributes:
        features: what is to be published, snapped and sorted: the epoch's with the decided changes.
        estimates: all hypotheses with all that is known now, published or not (candidates of one vehicle too), sorted
            by id and part.
        provenance: for each feature that differs from the epoch's by decision the ids of the reports that say so.
        tests: of each report that others can be compared with, whether they contradict it; sorted by report id.
        hypotheses: for `fold`.
    """

    features: tuple[Feature, ...]
    estimates: tuple[Feature, ...]
    provenance: dict[int, tuple[str, ...]]
    tests: tuple[ShiftTest, ...] = ()
    hypotheses: Hypotheses = field(default=Hypotheses((), {}, ()), compare=False, repr=False)


def merge_features(
    tile: TileId,
    epoch: Sequence[Feature],
    reports: Iterable[FeatureReport],
    parameters: FeatureMergeParameters | None = None,
    bases: Mapping[bytes, Sequence[Feature]] | None = None,
    refuted: Mapping[str, str] = MappingProxyType({}),
    memory: LayerMemory | None = None,
) -> MergedFeatures:
    """Decide what the reports of a window change in the features of a tile.

    Args:
        tile: whose features; frames are its own.
        epoch: the tile's features at its last base or rollback, () for an unmapped one.
        reports: all of the window, in any order; of each the part about this tile, and what was found in its
            neighbours near it, count. Reports that come again are ignored.
        parameters: see `FeatureMergeParameters`.
        bases: the features of the versions that reports refer to, by hash. The epoch's and "none" need not be given; a
            report about an unknown version says nothing of features that it does not name.
        refuted: reports that others contradict again and again, and whose each is (`refuted.py`): they are compared as
            all are, and say nothing.
        memory: the state that the closed windows since the epoch leave; None: there are none.
    """
    parameters = parameters or FeatureMergeParameters()
    own = FeatureTile.of(tile, 0, epoch)
    contents = contents_of({b"": (), own.sha: own.features, **(bases or {})})
    reports = list(reports)
    statements = statements_of(tile, reports, parameters.reach_m)
    tracks = _tracks_of(tile, epoch, statements, contents, parameters, memory)
    tests = tests_of(heard(tracks.all), statements, {one.report_id: one.last_ns for one in reports})
    if out := left_out(statements, tests, refuted):
        statements = tuple(one for one in statements if one.report_id not in out)
        tracks = _tracks_of(tile, epoch, statements, contents, parameters, memory)
    stories = tuple(story_of(tile, track, parameters) for track in tracks.all)
    outcomes = [(story, outcome) for story in stories if (outcome := story.outcome())]
    ids = (*(one.report_id for one in statements), *(() if memory is None else memory.witnesses))
    return MergedFeatures(
        features=FeatureTile.of(tile, 0, [o.published for _, o in outcomes if o.published is not None]).features,
        estimates=tuple(sorted((o.estimate for _, o in outcomes), key=lambda feature: feature.key)),
        provenance=_provenance(outcomes, ids),
        tests=tests,
        hypotheses=Hypotheses(stories, tracks.names_of(), ids),
    )


def _tracks_of(
    tile: TileId,
    epoch: Sequence[Feature],
    statements: Sequence[Statement],
    contents: Bases,
    parameters: FeatureMergeParameters,
    memory: LayerMemory | None,
) -> FeatureTracks:
    tracks = FeatureTracks(epoch, contents, parameters, memory)
    for number, statement in enumerate(statements):
        tracks.hear(number, statement)
    tracks.settle()
    add_views(tile, tracks, statements, contents)
    return tracks


def _provenance(outcomes: Iterable[tuple[Story, Outcome]], ids: Sequence[str]) -> dict[int, tuple[str, ...]]:
    found: dict[int, set[str]] = {}
    for story, outcome in outcomes:
        if outcome.is_decided:
            # numbers below 0 are those of witnesses, who stand at the end
            found.setdefault(story.track.feature_id, set()).update(ids[number] for number in outcome.reports)
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
    again = {tile for tile, some in parts.items() if any(one.vehicle in refuted.values() for one in some)}
    return {
        tile: merge_features(tile, epochs.get(tile, ()), parts[tile], parameters, refuted=refuted)
        if tile in again
        else one
        for tile, one in merged.items()
    }
