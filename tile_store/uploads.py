"""What vehicles have sent, as the store keeps it until it is understood."""

from dataclasses import dataclass, field
from typing import Final, Literal

from gnd.schemas.report_id import check_report_id
from gnd.tile_store.errors import StoreError
from gnd.tile_store.places import ReportPlace
from gnd.tile_store.values import ReportRow

UploadForm = Literal["packed", "gaussians", "whole", "features"]
UploadState = Literal["waiting", "early", "wanted", "released", "resend", "quarantined"]
"""waiting: nobody has looked at it yet; early: Gaussians whose flags have not come; wanted: flags, Gaussians are asked
for; released: all that is wanted is in the journal; resend: to be sent whole; quarantined: refused."""
FORMS: Final = ("packed", "gaussians", "whole", "features")


@dataclass(frozen=True, slots=True)
class Upload:
    """A message as it came: `body` on `key`. `vehicle` is "" where the message does not tell it (Gaussians)."""

    key: str
    body: bytes = field(repr=False)
    report_id: str
    vehicle: str
    form: UploadForm
    received_ns: int

    def __post_init__(self) -> None:
        check_report_id(self.report_id)
        if self.form not in FORMS:
            raise StoreError(f"upload of form {self.form!r}; there are {', '.join(FORMS)}")
        if (self.form == "gaussians") == bool(self.vehicle):
            raise StoreError(f"upload of form {self.form} names vehicle {self.vehicle!r}")


@dataclass(frozen=True, slots=True)
class UploadClaim:
    """One upload leased to one worker; `token` fences off who has lost the lease."""

    number: int
    upload: Upload
    owner: str
    token: int
    attempts: int


@dataclass(frozen=True, slots=True)
class FirstHalf:
    """Flags that have come, and what became of them.

    Attributes:
        number: of the upload.
        vehicle: that sent them.
        state: of the upload.
        wanted: the mask of Gaussians that are asked for; b"" none, or not decided yet.
        journal_id: the report id under which they are in the journal; "" they are not.
        body: as they came; b"" once all is here.
    """

    number: int
    vehicle: str
    state: UploadState
    wanted: bytes
    journal_id: str
    body: bytes = field(repr=False)


@dataclass(frozen=True, slots=True)
class Answered:
    """What Gaussians do to the flags that they belong to: their upload `number` gets another state."""

    number: int
    state: UploadState
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Settled:
    """What becomes of a claimed upload, applied all or not at all.

    Attributes:
        claim: whose lease must still be held.
        state: of the upload from now on.
        rows: for the journal.
        wanted: state "wanted": the mask.
        reason: state "resend" or "quarantined": why.
        first: of Gaussians: the flags that they answer.
        place: where its vehicle was, by the rows.
        is_impossible: it is refused because its vehicle cannot have been there.
    """

    claim: UploadClaim
    state: UploadState
    rows: tuple[ReportRow, ...] = ()
    wanted: bytes = b""
    reason: str = ""
    first: Answered | None = None
    place: ReportPlace | None = None
    is_impossible: bool = False


@dataclass(frozen=True, slots=True)
class UploadStatus:
    """How far a report has come."""

    report_id: str
    state: UploadState
    wanted: bytes
    reason: str


@dataclass(frozen=True, slots=True)
class UploadCounts:
    """How many uploads are in which state, and when the oldest one came at which nobody has looked (None: none is)."""

    by_state: dict[str, int]
    oldest_waiting_ns: int | None
