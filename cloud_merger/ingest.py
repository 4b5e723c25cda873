"""Reports come in: looked at from outside, kept as the bytes that came, and only then acknowledged.

Nothing is decoded here, no tile is read and no lock is held: an ack costs one commit, which all that come at the same
time share. What the bytes say is found out later (`expander`), and told on the vehicle's own key.
"""

import logging
from collections.abc import Callable

from gnd.cloud_merger.admission import Admission
from gnd.cloud_merger.errors import BadReport
from gnd.cloud_merger.patience import PatientWords
from gnd.fleet_bus.refusals import counted
from gnd.fleet_bus.seals import Holder
from gnd.fleet_bus.seldom import Seldom
from gnd.gnd_map.features import is_feature_layer
from gnd.schemas.changes import ChangeAck
from gnd.schemas.errors import SchemaError
from gnd.schemas.keys import parse_change_key
from gnd.schemas.limits import MAX_AHEAD_NS, MAX_REASON_CHARACTERS
from gnd.schemas.upload_head import UploadHead, head_of_upload
from gnd.tile_store import clocks
from gnd.tile_store.store import Store
from gnd.tile_store.uploads import Upload

_SELDOM = Seldom(logging.getLogger(__name__))


class Ingest:
    """Answers uploads. Safe to call from several threads.

    Args:
        store: where they are kept.
        home: name of this shard, which looks at what it has received before others do.
        on_stored: called after a new upload is durable.
        now_ns: the clock, int ns UTC.
        admission: who may send how much; None: all may.
        words: what vehicles are told with the ack of their next report.
    """

    def __init__(
        self,
        store: Store,
        home: str,
        on_stored: Callable[[], object] = lambda: None,
        now_ns: Callable[[], int] = clocks.day_ns,
        admission: Admission | None = None,
        words: PatientWords | None = None,
    ) -> None:
        self._store, self._home, self._on_stored, self._now_ns = store, home, on_stored, now_ns
        self._admission, self._words = admission, words or PatientWords()

    def answer(self, key: str, payload: bytes, asker: Holder | None = None) -> ChangeAck:
        """The ack of one message: "stored" and "duplicate" only when its bytes are durable.

        Args:
            key: where it came.
            payload: the message.
            asker: who has sealed it, where seals are demanded.

        Raises:
            StoreError: it could not be kept; the vehicle is to send it again.
            Busy: more than is admitted; the vehicle is to send it later.
        """
        received_ns, report_id, patient_s = self._now_ns(), "", 0.0
        try:
            head = head_of_upload(payload)
            report_id = head.report_id
            check_head(key, head, received_ns)
            self._check_asker(head, asker)
            if self._admission is not None:
                patient_s = self._admission.admit(key, head, len(payload))
        except (SchemaError, BadReport) as error:
            return self._refuse(key, payload, report_id, error)
        if asker is not None and asker.owner and head.vehicle:
            self._store.note_owner(head.vehicle, asker.owner, received_ns)
        upload = Upload(key, payload, report_id, head.vehicle, head.form, received_ns)
        if head.is_patient:
            self._words.expect(head.vehicle, report_id)  # before anybody looks at it
        status = self._store.put_upload(upload, self._home, patient_s)
        if status == "stored":
            self._on_stored()
        return ChangeAck(report_id, status, told=self._words.take(head.vehicle))

    def _check_asker(self, head: UploadHead, asker: Holder | None) -> None:
        """Who seals a report must be who it says it is of; Gaussians do not say it, but their flags did."""
        if asker is None:
            return
        if head.vehicle and head.vehicle != asker.name:
            raise BadReport(f"report {head.report_id} of {head.vehicle} was sealed by {asker}")
        if not head.vehicle and not self._store.upload_statuses(asker.name, [head.report_id]):
            raise BadReport(f"Gaussians of report {head.report_id}, of which {asker} has sent no flags")

    def _refuse(self, key: str, payload: bytes, report_id: str, error: Exception) -> ChangeAck:
        if self._admission is not None:
            self._admission.admit_nonsense()
        reason = one_line(f"{type(error).__name__}: {error}")
        self._store.quarantine(payload, reason, source=key)
        counted("upload", "unreadable")
        _SELDOM.warning("quarantined an upload of %d bytes on %s: %s", len(payload), key, reason)
        return ChangeAck(report_id, "quarantined", reason)


def check_head(key: str, head: UploadHead, received_ns: int) -> None:
    """Refuse what came on the wrong key, and what says that it was measured after it came.

    Old is welcome: recordings are replayed.

    Raises:
        BadReport: with numbers.
        SchemaError: no key of reports.
    """
    layer, district = parse_change_key(key)
    if head.form != "features" and is_feature_layer(layer):
        raise BadReport(f"an upload in form {head.form} speaks of Gaussians, layer {layer} holds features")
    if head.place not in (None, (layer, district)):
        raise BadReport(f"report for {head.place[0]} {head.place[1]} came on the key of {layer} {district}")
    if head.last_ns > received_ns + MAX_AHEAD_NS:
        raise BadReport(
            f"report {head.report_id} ends {(head.last_ns - received_ns) / 1e9:.0f} s after it was received, the limit "
            f"is {MAX_AHEAD_NS / 1e9:.0f} s: set the vehicle's clock"
        )


def one_line(text: str) -> str:
    """A reason as messages carry it."""
    printable = "".join(c if c.isprintable() else " " for c in text)
    return printable[:MAX_REASON_CHARACTERS]
