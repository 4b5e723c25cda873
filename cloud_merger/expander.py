"""What was acknowledged is looked at: uploads become rows of the journal, and vehicles hear what is wanted.

Any number of workers, threads or processes, may take from one store. An upload's rows, its state and what is wanted of
it are written in one transaction, fenced by the lease: a worker that is killed leaves an upload that waits, one that
comes late changes nothing.
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from ulid import ULID

from gnd.cloud_merger.checking import MapCheck
from gnd.cloud_merger.config import MAX_ATTEMPTS, RETRY_S, ShardConfig
from gnd.cloud_merger.errors import BadReport, MergerError, NotUnderstood
from gnd.cloud_merger.expanding import base_versions
from gnd.cloud_merger.features.kept import FeatureInbox
from gnd.cloud_merger.ingest import one_line
from gnd.cloud_merger.served import ServedCpu
from gnd.cloud_merger.short_reports import FirstSaid, ShortReports
from gnd.cloud_merger.states import STATUS
from gnd.cloud_merger.stored import Bases, encoded_parts
from gnd.cloud_merger.survey.inbox import SurveyInbox
from gnd.cloud_merger.wants import asked_voxels
from gnd.fleet_bus.refusals import counted
from gnd.fleet_bus.seldom import Seldom
from gnd.gnd_map.errors import GndError
from gnd.schemas.changes import ChangeReport
from gnd.schemas.errors import SchemaError
from gnd.schemas.features import FeatureReport
from gnd.schemas.keys import parse_change_key
from gnd.schemas.packed import PackedGaussians, PackedReport, crc_of, decode_upload
from gnd.schemas.report_id import deterministic_report_id
from gnd.schemas.report_states import ReportState
from gnd.schemas.survey import SurveyReport
from gnd.tile_store.errors import BLAMELESS, DistrictElsewhere, IdTaken, ImpossiblePlace, StoreDamaged, StoreError
from gnd.tile_store.places import ReportPlace
from gnd.tile_store.store import Store
from gnd.tile_store.uploads import Answered, FirstHalf, Settled, UploadClaim
from gnd.tile_store.values import ReportRow

UPLOADS_AT_ONCE: Final = 8
"""Uploads that a thread claims together."""
DAMAGED_RETRY_S: Final = 2.0
_LOG = logging.getLogger(__name__)
_SELDOM = Seldom(_LOG)
Tell = Callable[[str, ReportState], object]


@dataclass(frozen=True, slots=True)
class _Outcome:
    """What is to become of an upload, whom to tell, and what was promised by it."""

    settled: Settled
    vehicle: str = ""
    told: ReportState | None = None
    asks: FirstSaid | None = None


class Expander:
    """Takes uploads and settles them. Safe in several threads.

    Args:
        store: of uploads, reports and tiles.
        config: of the shard.
        tell: called with a vehicle and how far its report has come, after that is durable.
        on_journaled: called after reports have come into the journal.
        bases: versions of tiles in memory, if others use them, too.
    """

    def __init__(
        self,
        store: Store,
        config: ShardConfig,
        tell: Tell,
        on_journaled: Callable[[], object] = lambda: None,
        bases: Bases | None = None,
    ) -> None:
        self._store, self._config, self._tell, self._on_journaled = store, config, tell, on_journaled
        self._short = ShortReports(store, config.merge, config.want, bases or Bases(store))
        self._features = FeatureInbox(store, config.features, config.feature_layer, config.ingest.reach_tiles)
        self._map, self._surveys = MapCheck(store, config.ingest), SurveyInbox(store)
        self.served = ServedCpu()

    def work(self) -> int:
        """Settle some uploads; how many were claimed.

        Raises:
            StoreError: the store has failed; what was claimed waits for the end of its lease.
        """
        owner, lease_s = self._config.shard_id, self._config.lease_s
        claims = self._store.claim_uploads(owner, UPLOADS_AT_ONCE, lease_s, self.served.in_turn)
        for claim in claims:
            before_s = time.thread_time()
            vehicle = self._work_on(claim)
            self.served.spent(claim.upload.vehicle or vehicle, time.thread_time() - before_s)
        return len(claims)

    def _work_on(self, claim: UploadClaim) -> str:
        """Whose it was, where that was found out."""
        try:
            outcome = self._settled(self._understood(claim))
        # the store's fault, not the upload's: it waits until the page is mended, or the bodies can be read
        except (StoreDamaged, *BLAMELESS) as error:
            _SELDOM.warning("upload %s waits: %s", claim.upload.report_id, error)
            self._store.postpone_upload(claim, DAMAGED_RETRY_S, blameless=True)
            return ""
        except DistrictElsewhere as error:  # it went with its district: the other store looks at it
            _LOG.info("upload %s is not looked at here: %s", claim.upload.report_id, error)
            return ""
        except StoreError:
            raise
        except Exception as error:  # one upload never stops the others
            _SELDOM.exception("upload %s failed, attempt %d", claim.upload.report_id, claim.attempts)
            if claim.attempts < MAX_ATTEMPTS:
                self._store.postpone_upload(claim, RETRY_S * claim.attempts)
                return ""
            outcome = self._settled(self._set_aside(claim, f"{type(error).__name__}: {error}"))
        if outcome is None:
            return ""
        self._announce(outcome)
        return outcome.vehicle

    def _settled(self, outcome: _Outcome) -> _Outcome | None:
        """The outcome as it is durable now; None: nothing was applied."""
        try:
            is_applied = self._store.settle_upload(outcome.settled)
        except IdTaken as taken:
            outcome = self._renamed(outcome, taken)
            is_applied = self._store.settle_upload(outcome.settled)
        except ImpossiblePlace as error:
            outcome = self._refused(outcome.settled.claim, one_line(str(error)), is_impossible=True)
            is_applied = self._store.settle_upload(outcome.settled)
        if not is_applied and outcome.settled.state == "early":  # its flags have come meanwhile
            self._store.postpone_upload(outcome.settled.claim, 0.0)
        return outcome if is_applied else None

    def _announce(self, outcome: _Outcome) -> None:
        if outcome.settled.rows:
            self._on_journaled()
        if outcome.asks is not None:
            self._short.asks(outcome.asks)
        elif outcome.settled.state != "early":
            self._short.promises.forget(outcome.settled.claim.upload.report_id)
        if outcome.told is not None:
            self._tell(outcome.vehicle, outcome.told)

    def _understood(self, claim: UploadClaim) -> _Outcome:
        if claim.attempts > MAX_ATTEMPTS:  # it may be what killed the workers that claimed it before
            return self._set_aside(claim, "no worker that claimed it came to an end")
        try:
            return self._outcome(claim)
        except NotUnderstood as error:
            _SELDOM.info("asked for report %s whole: %s", claim.upload.report_id, error)
            return self._told(Settled(claim, "resend", reason=one_line(str(error))))
        except (SchemaError, BadReport) as error:
            return self._refused(claim, one_line(f"{type(error).__name__}: {error}"))

    def _outcome(self, claim: UploadClaim) -> _Outcome:
        said = decode_upload(claim.upload.body)
        if isinstance(said, FeatureReport):
            self._features.check(claim.upload.key, said)
            rows = tuple(self._features.rows(said, claim.upload.received_ns))
            return self._released(claim, rows, self._place_of(said))
        if isinstance(said, SurveyReport):
            self._surveys.keep(claim.upload.key, said, claim.upload.received_ns)
            return self._released(claim, ())
        if isinstance(said, PackedGaussians):
            return self._second_half(claim, said)
        if isinstance(said, PackedReport):
            return self._first_half(claim, said)
        self._map.check(said)
        return self._released(claim, self._rows_of_whole(claim, said), self._place_of(said))

    def _first_half(self, claim: UploadClaim, packed: PackedReport) -> _Outcome:
        layer, district = parse_change_key(claim.upload.key)
        new = (tile for tile, version in base_versions(packed, district) if not version)
        self._map.check_places(layer, new)  # it costs little, what follows does not
        report = self._short.expanded(claim.upload.key, packed)
        self._map.check(report)
        first = self._short.decided(report)
        if packed.measured:
            first = replace(first, mask=np.zeros_like(first.mask))  # all have come
        asked = {tile for tile, ids in asked_voxels(report, first.mask).items() if len(ids)}
        rows = tuple(
            replace(row, is_half=row.tile in asked, is_quiet=row.is_quiet or row.tile in first.hopeless)
            for row in self._rows_of(report, claim)
        )
        if not first.wanted:
            return self._released(claim, rows, self._place_of(report))
        return self._told(Settled(claim, "wanted", rows, first.wanted, place=self._place_of(report)), asks=first)

    def _second_half(self, claim: UploadClaim, gaussians: PackedGaussians) -> _Outcome:
        """Gaussians belong to those flags of their id and key that have asked for them."""
        key = claim.upload.key
        halves = self._store.first_halves(key, gaussians.report_id)
        if all(half.state == "waiting" for half in halves):
            return _Outcome(Settled(claim, "early"))
        asked = [half for half in halves if half.wanted and crc_of(half.wanted) == gaussians.wanted_crc]
        open_ones = [half for half in asked if half.state == "wanted"]
        if asked and not open_ones:
            return _Outcome(Settled(claim, "released"))  # they came before, in other bytes, or have come whole
        if not asked:
            raise BadReport(
                f"Gaussians of report {gaussians.report_id} answer mask {gaussians.wanted_crc:08x}; asked were "
                + (", ".join(f"{crc_of(half.wanted):08x}" for half in halves if half.wanted) or "none")
            )
        return self._answered(claim, open_ones[0], gaussians)

    def _answered(self, claim: UploadClaim, half: FirstHalf, gaussians: PackedGaussians) -> _Outcome:
        try:
            parts = self._short.completed(claim.upload.key, half, gaussians)
            for part in parts:
                self._map.check(part)
        except (GndError, NotUnderstood) as error:
            if isinstance(error, StoreError):
                raise
            reason = one_line(f"{type(error).__name__}: {error}")
            settled = Settled(claim, "quarantined", reason=reason, first=Answered(half.number, "resend", reason))
            return _Outcome(settled, half.vehicle, ReportState(gaussians.report_id, "resend", reason=reason))
        rows = tuple(row for part in parts for row in self._rows_of(part, claim, part=1))
        settled = Settled(claim, "released", rows, first=Answered(half.number, "released"))
        return _Outcome(settled, half.vehicle, ReportState(gaussians.report_id, "released"))

    def _rows_of_whole(self, claim: UploadClaim, report: ChangeReport) -> tuple[ReportRow, ...]:
        """A whole report whose flags are in the journal takes their place; it keeps the id that they have there."""
        halves = self._store.first_halves(claim.upload.key, report.report_id)
        flags = [half for half in halves if half.journal_id and half.vehicle == report.vehicle]
        if not flags:
            return self._rows_of(report, claim)
        renamed = replace(report, report_id=flags[0].journal_id)
        return self._rows_of(renamed, claim, part=1)

    def _rows_of(self, report: ChangeReport, claim: UploadClaim, part: int = 0) -> tuple[ReportRow, ...]:
        return rows_of(report, claim.upload.received_ns, part, together=self._config.merge.together)

    def _renamed(self, outcome: _Outcome, taken: IdTaken) -> _Outcome:
        """Another vehicle has this report id: the journal keeps this report under one of its own."""
        settled = outcome.settled
        rows = tuple(_under_own_id(row) for row in settled.rows)
        _SELDOM.warning("%s; kept as %s", taken, rows[0].report_id)
        return replace(outcome, settled=replace(settled, rows=rows))

    def _place_of(self, report: ChangeReport | FeatureReport) -> ReportPlace | None:
        """Where its vehicle was, if that is looked at."""
        tiles = [one.tile for one in report.tiles] if self._config.ingest.speeds else []
        return ReportPlace.of(report.report_id, report.last_ns, tiles) if tiles else None

    def _released(self, claim: UploadClaim, rows: tuple[ReportRow, ...], place: ReportPlace | None = None) -> _Outcome:
        return self._told(Settled(claim, "released", rows, place=place))

    def _refused(self, claim: UploadClaim, reason: str, *, is_impossible: bool = False) -> _Outcome:
        counted("upload", "impossible" if is_impossible else "refused")
        _SELDOM.warning("quarantined %s of report %s: %s", claim.upload.form, claim.upload.report_id, reason)
        return self._told(Settled(claim, "quarantined", reason=reason, is_impossible=is_impossible))

    def _set_aside(self, claim: UploadClaim, why: str) -> _Outcome:
        return self._refused(claim, one_line(f"set aside after {claim.attempts} attempts to read it: {why}"))

    def _told(self, settled: Settled, asks: FirstSaid | None = None) -> _Outcome:
        upload = settled.claim.upload
        if not upload.vehicle:
            return _Outcome(settled)  # Gaussians: whose they are, only their flags tell
        told = ReportState(upload.report_id, STATUS[settled.state], settled.wanted, settled.reason)
        return _Outcome(settled, upload.vehicle, told, asks)


def rows_of(report: ChangeReport, received_ns: int, part: int = 0, *, together: bool = False) -> tuple[ReportRow, ...]:
    """A report as the journal keeps it: one row a tile. `together`: what it does not decide upon is merged, too."""
    return tuple(
        ReportRow(
            report.report_id, report.layer, tile, report.vehicle, received_ns, body, change.base_sha, part,
            is_quiet=not len(change.changed) and not (together and len(change.unsure)),
        )
        for change, (tile, body) in zip(report.tiles, encoded_parts(report), strict=True)
    )  # fmt: skip


def _under_own_id(row: ReportRow) -> ReportRow:
    """The row of a report under an id made of its own and its vehicle, with the same time."""
    t_ms = ULID.from_str(row.report_id).milliseconds
    own_id = deterministic_report_id(t_ms, "of another vehicle", row.report_id, row.vehicle)
    said = decode_upload(row.body)
    if not isinstance(said, (ChangeReport, FeatureReport)):
        raise MergerError(f"row of report {row.report_id} holds a {type(said).__name__}")
    return replace(row, report_id=own_id, body=replace(said, report_id=own_id).encode())
