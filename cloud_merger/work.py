"""From claimed tiles to publications: load, decode, merge; a tile whose merge fails does not stop the others."""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final, TypeVar

from gnd.cloud_merger.belief import ShiftTests, courses_of
from gnd.cloud_merger.config import MAX_ATTEMPTS, RETRY_S, ShardConfig
from gnd.cloud_merger.features.kept import FeatureContents, said_of
from gnd.cloud_merger.features.window import LayerMerger, LayerState, names_of, refuted_of, windows_of
from gnd.cloud_merger.groups import joined, with_copies
from gnd.cloud_merger.map_parameters import has_hearing, judges_met, text_of, with_text
from gnd.cloud_merger.snapping import REMEMBERED_TILES, Snapping
from gnd.cloud_merger.statements import Report
from gnd.cloud_merger.stored import Bases, encode_state, lattice_of_tile, reports_by_window
from gnd.cloud_merger.window import MergedWindow, TileState, WindowMerger, fold, provenance_of
from gnd.fleet_bus.seldom import Seldom
from gnd.gnd_map.by_object import ByObject
from gnd.gnd_map.content import AnyTile
from gnd.gnd_map.features import Feature, FeatureTile, is_feature_layer
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import SchemaError
from gnd.tile_store.errors import BLAMELESS, DistrictElsewhere, StoreDamaged, StoreError, UnknownReports
from gnd.tile_store.store import Store
from gnd.tile_store.values import (
    QUARANTINED,
    Basis,
    Claim,
    ClosedWindow,
    Publication,
    PublishResult,
    ReportRow,
    TileWork,
    counted_out,
)

_LOG = logging.getLogger(__name__)
_SELDOM = Seldom(_LOG)
T = TypeVar("T")
StateT = TypeVar("StateT")
ReportsT = TypeVar("ReportsT")
MergedT = TypeVar("MergedT")
SETTLED_TOGETHER: Final = 4
"""Tiles; more would wait too long for each other."""
LEAST_IDLE_S: Final = 0.005
OTHERS_IDLE_S: Final = 0.05
"""While tiles of another shard are ready, a shard looks so often whether it should help."""


class Worker:
    """Merges claimed tiles.

    Args:
        store: of reports and tiles.
        config: of the shard.
        bases: versions of tiles in memory, if others use them, too.
    """

    def __init__(self, store: Store, config: ShardConfig, bases: Bases | None = None) -> None:
        self._store, self._config = store, config
        self._contents, self._features = bases or Bases(store), FeatureContents(store)
        self._shifts, self._parameters = ShiftTests(), text_of(config)
        self._configs = {"": config, self._parameters: config}
        self._snapping, self._made = Snapping(), ByObject[Tile](REMEMBERED_TILES)
        self._begun: dict[Claim, bool] = {}  # whether the lease was still held

    def merge(self, claims: Sequence[Claim]) -> list[Publication]:
        """What to publish for these claims; a tile that failed is postponed, or set aside after `MAX_ATTEMPTS`."""
        attempted = [self._attempt(claim) for claim in claims]
        return [publication for publication in attempted if publication is not None]

    def begin(self, claims: Sequence[Claim]) -> None:
        """Count the first attempts of these claims together: one synced write, not one a tile. A tile that was tried
        before is counted when its turn comes, so that a merge that kills shards counts against its own tile alone.
        """
        first = [claim for claim in claims if claim.attempts == 1 and not claim.is_retry]
        held = self._store.begin(first, self._config.lease_s) if first else []
        self._begun = dict(zip(first, held, strict=True))

    def settle(self, claim: Claim) -> PublishResult | None:
        """Merge one claimed tile and publish it; None: it is postponed or set aside, or its lease is gone."""
        (result,) = self.settle_some([claim])
        return result

    def settle_some(self, claims: Sequence[Claim]) -> list[PublishResult | None]:
        """Merge claimed tiles and publish them in one transaction, as `settle` does with each. `in_turn` says which may
        be settled together.
        """
        attempted = [self._attempt(claim) for claim in claims]
        publications = [one for one in attempted if one is not None]
        try:
            results = iter(self._store.publish(publications))
        except (
            StoreDamaged,
            UnknownReports,
            DistrictElsewhere,
        ):  # one of them is to blame; any other is the store's failure
            return [None if one is None else self._published(one) for one in attempted]
        except BLAMELESS as error:
            for one in publications:
                self._wait_for(one.claim, error)
            return [None] * len(attempted)
        return [None if one is None else next(results) for one in attempted]

    def _published(self, publication: Publication) -> PublishResult | None:
        try:
            (result,) = self._store.publish([publication])
        except DistrictElsewhere as error:  # the other store merges it
            _LOG.info("%s is not merged here: %s", publication.claim.tile, error)
            return None
        except (StoreDamaged, UnknownReports) as error:
            self._failed(publication.claim, error)
            return None
        except BLAMELESS as error:
            self._wait_for(publication.claim, error)
            return None
        return result

    def idle_s(self, ready_in_s: float | None) -> float:
        """How long to sleep: until the next tile is ready, at most `poll_s`; one that is ready and was not given is
        another shard's.
        """
        poll_s = self._config.poll_s
        if ready_in_s is None:
            return poll_s
        return min(OTHERS_IDLE_S if ready_in_s <= 0.0 else max(ready_in_s, LEAST_IDLE_S), poll_s)

    def _attempt(self, claim: Claim) -> Publication | None:
        is_held = self._begun.pop(claim, None)
        if is_held is None:
            (is_held,) = self._store.begin([claim], self._config.lease_s)
        if not is_held:
            return None  # another shard has it
        # It may be what killed the shards that merged it before.
        if claim.attempts > MAX_ATTEMPTS and not claim.is_retry:
            self._set_aside(claim, "no shard that merged it came to an end")
            return None
        try:
            named = self._named(
                claim.layer, claim.tile
            )  # before the tile is read: the store refuses what both together do not fit
            work = self._store.load(claim)
            return self._of_features(work) if is_feature_layer(claim.layer) else self._of_gaussians(work, named)
        except BLAMELESS as error:
            self._wait_for(claim, error)
        except StoreError as error:
            if not isinstance(error, StoreDamaged):
                raise  # the store's failure, not the tile's
            self._failed(claim, error)
        except Exception as error:
            self._failed(claim, error)
        return None

    def _wait_for(self, claim: Claim, error: StoreError) -> None:
        """Try again later, for as long as it takes: it is not the tile's fault."""
        _SELDOM.warning("%s is not merged now: %s", claim.tile, error)
        self._store.postpone(claim, RETRY_S, blameless=True)

    def _failed(self, claim: Claim, error: Exception) -> None:
        """Try again later, not for ever."""
        _LOG.error("merge of %s failed, attempt %d", claim.tile, claim.attempts, exc_info=error)
        if claim.attempts >= MAX_ATTEMPTS:
            self._set_aside(claim, f"{type(error).__name__}: {error}")
        else:
            self._store.postpone(claim, RETRY_S * claim.attempts)

    def _named(self, layer: str, tile: TileId) -> frozenset[str]:
        """Who is shifted again and again, who does not count, who is behind a version of this tile that was withdrawn
        (alone they change nothing here until they are cleared), who is not believed alone, and who has one vote with
        others.
        """
        out = (QUARANTINED + vehicle for vehicle in self._store.quarantined_vehicles())
        marks = self._store.marks_of_tile(layer, tile)
        return self._store.shifted_vehicles().union(out, self._store.doubted_vehicles(layer, tile), marks)

    def _of_gaussians(self, work: TileWork, named: frozenset[str]) -> Publication:
        """Of a tile of the voxel map."""
        tile = work.claim.tile
        folded = self._folded_before(work)
        by_window = reports_by_window(
            work.reports,
            lambda window: self._with(folded[window].parameters if window in folded else "").merge,
            self._unreadable,
        )
        state, merges, closed, again = self._merged(work, by_window, folded, named)
        with_new = with_copies(named, joined(one for merged in merges for one in merged.coincidences))
        if with_new != named:  # what was sent twice decides in no version, not even until the store knows
            named = with_new
            state, merges, closed, again = self._merged(work, by_window, folded, named)
        now, version = merges[-1], work.base_version + 1
        # others were judged when they were closed
        windows = zip([*closed, work.journal.window], merges, strict=True)
        new_merges = [
            (window, merged) for window, merged in windows if window not in again
        ]  # others were judged before
        # the very object where nothing was decided otherwise: its hash is known
        new = self._made.of(now.gaussians, lambda: Tile(tile, version, now.gaussians), (tile, version))
        self._contents.keep(new)
        return replace(
            self._publication(work, new, len(new.gaussians), named, [one for one in closed if one not in again]),
            voxel_reports=provenance_of(merges),
            waiting=now.gated.waiting,
            shift_tests=tuple(test for one in merges for test in one.believed.tests),
            agreement_tests=tuple(test for _, merged in new_merges for test in merged.agreement),
            standings=tuple(one for window, merged in new_merges for one in merged.standings(window)),
            coincidences=joined(one for _, merged in new_merges for one in merged.coincidences),
            courses=courses_of(one for reports in by_window.values() for one in reports),
            memory=encode_state(tile, closed[-1], state) if closed else None,
        )

    def _merged(
        self,
        work: TileWork,
        by_window: Mapping[int, Sequence[Report]],
        folded: Mapping[int, ClosedWindow],
        named: frozenset[str],
    ) -> tuple[TileState, list[MergedWindow], list[int], Mapping[int, ClosedWindow]]:
        """What `_through_windows` gives, and how those windows are folded anew that were folded before, because
        somebody else counts now: as then, but for who does not count.
        """
        epoch = Gaussians.empty() if work.epoch is None else self._contents.decoded(work.epoch)
        now_so = ClosedWindow(named, self._parameters)
        again = {
            window: ClosedWindow(how.named - counted_out(how.named) | counted_out(named), how.parameters)
            for window, how in folded.items()
            if window in by_window
        }
        mergers = {how: self._merger(work, how) for how in {now_so, *again.values()}}

        def merge(window: int, state: TileState, reports: Sequence[Report] | None) -> MergedWindow:
            how = again.get(window, now_so)
            lattice = lattice_of_tile(work.epoch, epoch, self._with(how.parameters).codec)
            return mergers[how].merge(state, reports or [], lattice)

        state, merges, closed = _through_windows(
            self._contents.state(work.claim.tile, work.journal),
            by_window,
            work.journal.window,
            merge,
            lambda state, merged, _reports: fold(state, merged),
        )
        return state, merges, closed, again

    def _folded_before(self, work: TileWork) -> dict[int, ClosedWindow]:
        """How the closed windows were folded, where reports of them are to be folded anew."""
        if all(row.window >= work.journal.window for row in work.reports):
            return {}
        told = self._store.closed_windows(work.claim.layer, work.claim.tile)
        return {
            window: replace(how, parameters=how.parameters or self._parameters)
            for window, how in told.items()
            if window < work.journal.window
        }

    def _with(self, parameters: str) -> ShardConfig:
        """The configuration with which a window was merged; "": the shard's own."""
        if parameters not in self._configs:
            self._configs[parameters] = with_text(self._config, parameters)
        return self._configs[parameters]

    def _merger(self, work: TileWork, how: ClosedWindow) -> WindowMerger:
        config = self._with(how.parameters)
        return WindowMerger(
            config.merge,
            config.confirmation,
            self._shifts,
            self._bases(work),
            how.named,
            self._snapping,
            has_hearing(how.parameters),
            self._store.owners_of({row.vehicle for row in work.reports}),
            judges_met(how.parameters),
        )

    def _of_features(self, work: TileWork) -> Publication:
        """Of a tile of a feature layer."""
        layer, tile, journal = work.claim.layer, work.claim.tile, work.journal
        epoch = () if work.epoch is None else work.epoch.decode_features().features
        rows = [row for row in work.reports if self._readable(row, said_of) is not None]
        named = names_of(self._store.refuted_reports(layer, {row.vehicle for row in rows}), rows)
        merger = LayerMerger(tile, self._config.merge_of(layer), self._feature_bases(work), refuted_of(named))
        state, merges, closed = _through_windows(
            LayerState.stored(epoch, journal.memory),
            windows_of(rows),
            journal.window,
            lambda _window, state, said: merger.merge(state, said),
            merger.fold,
        )
        new = FeatureTile(tile, work.base_version + 1, merges[-1].features)
        return replace(
            self._publication(work, new, len(new.features), named, closed),
            voxel_reports={feature: ids for one in merges for feature, ids in one.provenance.items()},
            shift_tests=tuple(test for one in merges for test in one.tests),
            memory=state.encoded(closed[-1]) if closed else None,
        )

    def _publication(
        self, work: TileWork, new: AnyTile, size: int, named: frozenset[str], closed: Sequence[int]
    ) -> Publication:
        """What both kinds of tiles publish; the tile is None where the head has that content."""
        is_new = new.sha != work.head.sha if work.head else size > 0
        return Publication(
            claim=work.claim,
            base_version=work.base_version,
            tile=new if is_new else None,
            report_ids=tuple(row.report_id for row in work.reports),
            basis=Basis(work.journal.window, work.journal.seq, named, self._parameters),
            closed=tuple(closed),
            trial=self._config.release.terms,
        )

    def _feature_bases(self, work: TileWork) -> dict[bytes, tuple[Feature, ...]]:
        """The versions that reports about features refer to, by hash; those that the store has lost are missing."""
        shas = sorted({row.base_sha for row in work.reports})
        found = {sha: self._features.content(work.claim.layer, work.claim.tile, sha) for sha in shas}
        return {sha: features for sha, features in found.items() if features is not None}

    def _readable(self, row: ReportRow, read: Callable[[bytes], T]) -> T | None:
        """What a stored report says; nothing when it can no longer be read (its vehicle has long had its ack)."""
        try:
            return read(row.body)
        except SchemaError as error:
            self._unreadable(row, error)
            return None

    def _unreadable(self, row: ReportRow, error: SchemaError) -> None:
        reason = f"report {row.report_id} on tile {row.tile} cannot be read any more and is left out: {error}"
        _LOG.error("%s", reason)
        self._store.quarantine(row.body, reason, source="merge")

    def _bases(self, work: TileWork) -> dict[bytes, Gaussians]:
        """The versions that the reports refer to, by hash; those that the store has lost are missing."""
        shas = {row.base_sha for row in work.reports if row.base_sha}
        found = {sha: self._contents.content(work.claim.layer, work.claim.tile, sha) for sha in sorted(shas)}
        return {sha: gaussians for sha, gaussians in found.items() if gaussians is not None}

    def _set_aside(self, claim: Claim, reason: str) -> None:
        """Leave the tile as it is, by name; its reports go on waiting."""
        if self._store.set_aside(claim, reason):
            _LOG.error("tile %s is set aside after %d attempts to merge it: %s", claim.tile, claim.attempts, reason)


def in_turn(claims: Sequence[Claim]) -> Iterator[Sequence[Claim]]:
    """The claims as they are settled: a few first attempts share a synced write. A tile that was tried before goes
    alone: what kills a shard shall take no other tile with it again.
    """
    first: list[Claim] = []
    for claim in claims:
        if claim.attempts > 1 or claim.is_retry:
            yield [claim]
            continue
        first.append(claim)
        if len(first) == SETTLED_TOGETHER:
            yield first
            first = []
    if first:
        yield first


def _through_windows(
    state: StateT,
    by_window: Mapping[int, ReportsT],
    open_window: int,
    merge: Callable[[int, StateT, ReportsT | None], MergedT],
    fold_in: Callable[[StateT, MergedT, ReportsT], StateT],
) -> tuple[StateT, list[MergedT], list[int]]:
    """Fold the windows that are closed into the state, then merge the open one.

    Returns:
        The state before the open window; what each window was merged to, the open one last; the closed windows.
    """
    closed, merges = [window for window in sorted(by_window) if window < open_window], list[MergedT]()
    for window in closed:
        merges.append(merge(window, state, by_window[window]))
        state = fold_in(state, merges[-1], by_window[window])
    merges.append(merge(open_window, state, by_window.get(open_window)))
    return state, merges, closed
