"""The values that go into a store and come out of it. Times are int ns UTC; the store never reads a report's body."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from hashlib import sha256
from math import ceil
from typing import Final, Literal

from gnd.gnd_map.codec import LATTICES, Lattice
from gnd.gnd_map.content import AnyTile, encode_content, fits_layer, noun_of
from gnd.gnd_map.day import UNKNOWN_DAY, day_of
from gnd.gnd_map.features import FeatureTile
from gnd.gnd_map.settings import check_settings, setting
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.limits import MAX_TILE_BODY_BYTES
from gnd.schemas.report_id import check_report_id
from gnd.schemas.tiles import TileBlob, content_of, features_of, tile_of
from gnd.schemas.version_signature import VersionSignature, VersionStatement
from gnd.schemas.wire import LAYER_PATTERN
from gnd.tile_store.errors import StoreError
from gnd.tile_store.trials import TrialTerms

VersionKind = Literal["base", "merged", "rollback"]
PutStatus = Literal["stored", "duplicate"]
PublishStatus = Literal["published", "unchanged", "stale"]
WaitingReason = Literal[
    "share", "isolated", "poses", "doubtful", "shift", "named", "parked", "season", "contradicted", "day", "quarantined"
]
QUARANTINED: Final = "!"
"""Before the name of a vehicle among those named: its reports do not count at all."""


def counted_out(named: frozenset[str]) -> frozenset[str]:
    """Those of the names that say whose reports do not count, as they stand there."""
    return frozenset(name for name in named if name.startswith(QUARANTINED))


SHA_BYTES: Final = 32
CHECK_BYTES: Final = 16
NS_PER_S: Final = 1_000_000_000
DEFAULT_LAYER: Final = "ndt"
DEFAULT_CODEC: Final = "standard"
MAP_CODECS: Final = (*LATTICES, "float")
"""How finely published Gaussians are rounded: the lattices, coarsest last, or as they were measured."""


def check_layer(layer: str) -> str:
    """The layer's name itself; StoreError when it cannot be a chunk of a key."""
    if not LAYER_PATTERN.fullmatch(layer):
        raise StoreError(f"layer {layer[:80]!r} does not match {LAYER_PATTERN.pattern}")
    return layer


def check_fits(tile: AnyTile, layer: str) -> None:
    """StoreError unless the tile holds what the layer holds: Gaussians if its name begins with ndt, else features."""
    if not fits_layer(tile, layer):
        raise StoreError(
            f"tile {tile.tile_id.path} holds {noun_of(tile)}, layer {layer!r} does not: layers whose names begin with"
            " ndt hold Gaussians, all others features"
        )


def lattice_named(codec: str) -> Lattice | None:
    """The lattice that a name of `MAP_CODECS` means, None for floats; StoreError for any other name."""
    if codec not in MAP_CODECS:
        raise StoreError(f"codec {codec!r} is unknown; known are {', '.join(MAP_CODECS)}")
    return LATTICES.get(codec)


SHARD_SILENT_S: Final = 15.0
"""A shard that has been silent for so long counts as gone."""

REFUTED_TESTS: Final = 3
"""A report is refuted after so many tiles in which it stands alone against others, ..."""
REFUTED_SHARE: Final = 0.5
"""... if they are so many of all that could be compared."""


def check_of_body(sha: bytes, codec_id: int, body: bytes) -> bytes:
    """What tells, without decoding, that a body is the one that was encoded for a content: 16 bytes of the SHA-256 of
    the content's hash (32 bytes), the codec (4 bytes, little-endian) and the body.
    """
    return sha256(b"".join((sha, codec_id.to_bytes(4, "little"), body))).digest()[:CHECK_BYTES]


@dataclass(frozen=True, slots=True)
class Content:
    """A tile's content as a store keeps it: hash, codec and encoded bytes.

    `kept_s` is when, by `time.monotonic`, its body was about to be put among the objects of the store; None: it is not
    there. An empty body lies there already, named by another version. `check` is `check_of_body` of the body as it was
    encoded; None: nobody knows, the content is from an older version of the store.
    """

    sha: bytes
    codec_id: int
    body: bytes = field(repr=False)
    kept_s: float | None = None
    check: bytes | None = None

    @classmethod
    def of(cls, tile: AnyTile) -> "Content":
        """The content of a tile in the best codec that can express it: what lies on a lattice in that lattice's, other
        floats as they are, features in theirs. StoreError when it is larger than any message may be.
        """
        codec_id, body = encode_content(tile)
        if len(body) > MAX_TILE_BODY_BYTES:
            raise StoreError(f"tile {tile.tile_id.path} has {len(body)} bytes, a message holds {MAX_TILE_BODY_BYTES}")
        return cls(tile.sha, codec_id, body, check=check_of_body(tile.sha, codec_id, body))


@dataclass(frozen=True, slots=True)
class StoreConfig:
    """How a store batches and waits; each process may use its own."""

    merge_delay_s: float = setting(
        1.0,
        "A tile becomes ready to merge this long after its first waiting report ...",
        unit="s",
        least=0,
    )
    merge_after_reports: int = setting(8, "... or at once when so many reports wait.", least=1)
    window_s: float = setting(
        1800.0,
        "A tile's window closes when a report comes so long after its first (by receipt): a vehicle that "
        "comes back after that has come on another drive; in feature layers where the time of day passes a "
        "multiple of it, so that neighbours, who hear the same of what lies at their border, cut alike ...",
        unit="s",
        above=0,
    )
    window_reports: int = setting(
        96,
        "... or when it holds so many: what one merge has to read stays bounded.",
        least=1,
    )
    quarantine_mb: float = setting(
        64.0,
        "Of the newest refused messages so much is kept: nobody can fill the disk with nonsense.",
        unit="MB",
        above=0,
    )

    def __post_init__(self) -> None:
        check_settings(self, StoreError)

    @property
    def quarantine_bytes(self) -> int:
        """How much of the refused messages is kept, bytes."""
        return round(self.quarantine_mb * 1e6)


@dataclass(frozen=True, slots=True)
class ReportRow:
    """What one report says about one tile: the unit of the inbox.

    `base_sha` is the content hash that the report refers to (b"": none); gc keeps that version while the report counts.
    """

    report_id: str
    layer: str
    tile: TileId
    vehicle: str
    received_ns: int
    body: bytes = field(repr=False)
    base_sha: bytes = b""
    part: int = 0
    """0: flags, or the whole report; 1: the same with the Gaussians that were asked for later, in place of part 0."""
    is_quiet: bool = field(default=False, compare=False)
    """It says of all that it observed "as in the base", or nothing that could win: where the base is the newest version
    and nothing else waits, it is counted when the tile is merged for another reason."""
    is_half: bool = field(default=False, compare=False)
    """Its Gaussians are asked for: the tile is not merged on its account alone before they had time to come."""
    window: int = field(default=0, compare=False)
    """Of the tile's journal; the store assigns it, and the number in it, when the report becomes durable."""
    seq: int = field(default=0, compare=False)

    def __post_init__(self) -> None:
        check_layer(self.layer)
        check_report_id(self.report_id)
        if self.part not in (0, 1):
            raise StoreError(f"report {self.report_id} has part {self.part}; there are 0 and 1")
        if len(self.base_sha) not in (0, SHA_BYTES):
            raise StoreError(f"base_sha has {len(self.base_sha)} bytes, need 0 or {SHA_BYTES}")


@dataclass(frozen=True, slots=True)
class StoredTile:
    """One version of a tile as it lies in the store; `parent` is the version that it replaced (0: none)."""

    layer: str
    tile: TileId
    version: int
    parent: int
    kind: VersionKind
    created_ns: int
    merger: str
    n_reports: int
    sha: bytes
    codec_id: int
    body: bytes = field(repr=False)
    surveyed_ns: int | None = None
    """When the world was measured of which a base was built; None: not told, or no base."""
    body_check: bytes | None = field(default=None, repr=False)
    """`check_of_body` when the body was encoded; None: the version is older than these."""
    signature: VersionSignature | None = field(default=None, repr=False)
    """Of who answers for it; None: nobody does."""

    @property
    def is_as_encoded(self) -> bool:
        """Whether the body is known to be the one that was encoded for this hash: nobody needs to decode it. False: it
        is not, or not known.
        """
        return self.body_check is not None and self.body_check == check_of_body(self.sha, self.codec_id, self.body)

    @property
    def statement(self) -> VersionStatement:
        """What its publisher signs."""
        return VersionStatement(
            self.layer, self.tile, self.version, self.sha, self.kind, self.day, self.created_ns // NS_PER_S
        )

    @property
    def day(self) -> int:
        """When the world looked so: of a merge the day of its publication, of a base that of its survey. What is
        published again is as old as it was, which nobody has written down.
        """
        return day_of_version(self.kind, self.created_ns, self.surveyed_ns)

    def to_blob(self) -> TileBlob:
        """What goes out on the bus."""
        return TileBlob(self.tile, self.version, self.sha, self.codec_id, self.body, self.day)

    def decode(self) -> AnyTile:
        """The tile itself; WrongHash when the bytes are not what the hash says."""
        return content_of(self.to_blob())

    def decode_gaussians(self) -> Tile:
        """As `decode`, of a layer of Gaussians; BadValue when it holds features."""
        return tile_of(self.to_blob())

    def decode_features(self) -> FeatureTile:
        """As `decode`, of a feature layer; BadValue when it holds Gaussians."""
        return features_of(self.to_blob())


def day_of_version(kind: VersionKind, created_ns: int, surveyed_ns: int | None) -> int:
    """As `StoredTile.day`, of a version that does not lie in the store yet."""
    if kind == "merged":
        return day_of(created_ns)
    return UNKNOWN_DAY if surveyed_ns is None else day_of(surveyed_ns)


@dataclass(frozen=True, slots=True)
class VersionInfo:
    """A line of a tile's history: a version without its body of `size_bytes`."""

    version: int
    parent: int
    kind: VersionKind
    created_ns: int
    merger: str
    n_reports: int
    sha: bytes
    size_bytes: int


@dataclass(frozen=True, slots=True)
class HeadLine:
    """A tile's newest version without its body."""

    tile: TileId
    version: int
    created_ns: int
    codec_id: int
    size_bytes: int


@dataclass(frozen=True, slots=True)
class Claim:
    """A lease on a dirty tile. `seq` counts the reports that had arrived, `token` tells this lease from any other,
    `attempts` says which attempt to merge the tile since it was last published begins with it (1: the first);
    `is_retry`: the tile is set aside, and this is one more attempt after a pause.
    """

    layer: str
    tile: TileId
    seq: int
    owner: str
    token: int = 0
    attempts: int = 1
    is_retry: bool = False


@dataclass(frozen=True, slots=True)
class StoredMemory:
    """What the closed windows of a tile up to `window` have come to: the Gaussians that the next window is merged into,
    encoded, and what else is remembered, which the store does not read.
    """

    window: int
    codec_id: int
    body: bytes = field(repr=False)
    memory: bytes = field(repr=False)


@dataclass(frozen=True, slots=True)
class Basis:
    """What of its tile's journal a version was made of: all windows before `window` since the epoch, and of that one
    the entries up to number `seq`; which vehicles were named then (of a feature layer: which reports were refuted), and
    the parameters that it was merged with, as a text that the store does not read ("": not known).
    """

    window: int
    seq: int
    named: frozenset[str] = frozenset()
    parameters: str = ""


@dataclass(frozen=True, slots=True)
class ClosedWindow:
    """How a window was folded: which vehicles (of a feature layer: reports) were named then, and with which parameters;
    "": they are not known.
    """

    named: frozenset[str]
    parameters: str = ""


@dataclass(frozen=True, slots=True)
class WindowCounts:
    """The open window of a tile: its number, entries of the journal so far, when it was opened (None: it is empty),
    its reports, and the newest window that is folded (None: none).
    """

    layer: str
    tile: TileId
    window: int
    seq: int
    opened_ns: int | None
    reports: int
    folded: int | None


@dataclass(frozen=True, slots=True)
class JournalMark:
    """How far a tile's journal has been read.

    Attributes:
        epoch: version of the latest base or rollback; 0: the map has no such tile.
        folded: the newest window that is folded into it.
        seq: number of the newest entry.
    """

    epoch: int
    folded: int
    seq: int


@dataclass(frozen=True, slots=True)
class TileJournal:
    """What counts of a tile, read at one instant.

    Attributes:
        epoch: the latest base or rollback; None: the map has no such tile.
        reports: of the windows that are not folded, merged or not, sorted by report id and part.
        memory: what the closed windows since the epoch have come to; None: none is folded.
        window: the open one.
        seq: number of the newest entry.
        is_whole: the reports reach to the end of the journal; else `window` and `seq` say how far, and all are closed.
        mark: to ask for what comes later; None: not whole, or a layer without windows.
    """

    epoch: StoredTile | None
    reports: tuple[ReportRow, ...] = ()
    memory: StoredMemory | None = None
    window: int = 0
    seq: int = 0
    is_whole: bool = True
    mark: JournalMark | None = None


@dataclass(frozen=True, slots=True)
class TileWork:
    """All that a merge needs, read at one instant: the newest version, and what counts since the epoch."""

    claim: Claim
    head: StoredTile | None
    journal: TileJournal

    @property
    def epoch(self) -> StoredTile | None:
        """The latest base or rollback."""
        return self.journal.epoch

    @property
    def reports(self) -> tuple[ReportRow, ...]:
        """Of the windows that are not folded, merged or not, sorted by report id and part."""
        return self.journal.reports

    @property
    def base_version(self) -> int:
        """The version that a publication of this work replaces (0: the tile does not exist)."""
        return self.head.version if self.head else 0


@dataclass(frozen=True, slots=True)
class DirtyTile:
    """A tile that waits to be merged: reports that are not merged yet, how often it was tried; `is_leased`: a shard is
    at it; `overdue_s`: for so long it has been ready, by the queue's clock.
    """

    layer: str
    tile: TileId
    reports: int
    attempts: int
    is_leased: bool
    overdue_s: float = field(default=0.0, compare=False)  # of now, not of the tile

    def __post_init__(self) -> None:
        object.__setattr__(self, "is_leased", bool(self.is_leased))


@dataclass(frozen=True, slots=True)
class TileSetAside:
    """A tile that could not be read or merged, since when (UTC), after how many attempts, and why; its reports wait."""

    layer: str
    tile: TileId
    since_ns: int
    attempts: int
    reports: int
    reason: str


@dataclass(frozen=True, slots=True)
class QueueState:
    """How the queue stands.

    Attributes:
        overdue_s: since when a tile that is ready has not been merged, by the queue's clock; 0: none is.
        waiting_s: since when a report waits that no merge has read, by the time of day; tiles set aside do not count.
        lags_s: from receipt to published version, of the newest report parts that made one, sorted.
        quarantined: refused messages, ...
        quarantined_bytes: ... and their bytes.
    """

    overdue_s: float
    waiting_s: float
    lags_s: tuple[float, ...]
    quarantined: int
    quarantined_bytes: int

    def lag_s(self, share: float) -> float | None:
        """The lag that this share of the newest parts did not exceed; None: nothing was published yet."""
        return self.lags_s[ceil(share * len(self.lags_s)) - 1] if self.lags_s else None


@dataclass(frozen=True, slots=True)
class ShardSeen:
    """A merger shard: when it joined (UTC), and how long ago it gave its last sign of life (None: before this boot)."""

    owner: str
    since_ns: int
    silent_s: float | None

    @property
    def is_alive(self) -> bool:
        """Whether it has been heard of lately."""
        return self.silent_s is not None and self.silent_s < SHARD_SILENT_S


@dataclass(frozen=True, slots=True)
class Unconfirmed:
    """What one vehicle alone claims about a tile, and why it is not published.

    Attributes:
        vehicle: the only witness.
        report_ids: of its reports that claim it, sorted.
        voxels: so many.
        seen: voxels of the tile that it observed and that hold something, before or by its word.
        reason: "share": too large a share; "isolated": little, but nothing beside it has come or gone; "poses": of
            reports with poor poses only; "doubtful": the vehicle doubts it itself; "shift": a shift of its poses
            explains it; "named": its reports are shifted again and again; "parked": it has the shape of a vehicle
            and has not stood for long, whoever saw it; "season": it came or went in the crown of a tree that stayed;
            "contradicted": others contradict most of what the vehicle claims there, or in other tiles;
            "day": it has changed as much alone on that day as one vehicle may;
            "quarantined": of a vehicle whose reports do not count.
    """

    vehicle: str
    report_ids: tuple[str, ...]
    voxels: int
    seen: int
    reason: WaitingReason


@dataclass(frozen=True, slots=True)
class ShiftTest:
    """Whether the changes that a report claims in a tile are an error of its poses.

    Attributes:
        report_id: the report.
        vehicle: who made it.
        at_ns: time of its last scan, UTC.
        is_explained: a shift explains them, and no other vehicle sees the same.
        length_m: length of the shift over the ground.
        turn_rad: its turn, counter-clockwise seen from above.
        forward_m: along the vehicle's axes where the vehicle has told it so, else None.
        left_m: the same.
    """

    report_id: str
    vehicle: str
    at_ns: int
    is_explained: bool
    length_m: float
    turn_rad: float
    forward_m: float | None = None
    left_m: float | None = None


@dataclass(frozen=True, slots=True)
class AgreementTest:
    """How a report's statements about a tile agree with those of others within the same half hour.

    Attributes:
        report_id: the report.
        vehicle: who made it.
        at_ns: time of its last scan, UTC.
        claims: changes that it claims and others can judge, ...
        refuted_claims: ... of which so many are contradicted.
        quotes: voxels that are as they were, by its word, and that others can judge, ...
        refuted_quotes: ... of which so many have changed by theirs.
        is_refuted: it is contradicted as a whole.
        seen: voxels of the tile that it has seen and others could judge, those included that it says have come; 0: not
            known.
    """

    report_id: str
    vehicle: str
    at_ns: int
    claims: int
    refuted_claims: int
    quotes: int
    refuted_quotes: int
    is_refuted: bool
    seen: int = 0


@dataclass(frozen=True, slots=True)
class VehicleStanding:
    """How a vehicle stands in one window of a tile, by that window's reports.

    Attributes:
        vehicle: its pseudonym.
        window: of the tile's journal.
        at_ns: time of the last scan of its newest report there, UTC.
        day: when that report was received, in days since 1970.
        alone: voxels that are changed on its word alone, whether or not it has changed too much alone on that day.
        shared: voxels that are changed on its word and that of others.
        judged: changes that it claims and somebody else has seen, too, ...
        denied: ... of which so many are denied by more than say the same.
        unheard: of so many kinds its statements do not count there.
    """

    vehicle: str
    window: int
    at_ns: int
    day: int
    alone: int
    shared: int
    judged: int
    denied: int
    unheard: int


@dataclass(frozen=True, slots=True)
class Coincidence:
    """How far what two vehicles claim coincides in a tile in which others contradict both as a whole; or that the one
    has sent what the other has measured, to the bit.

    Attributes:
        one: the vehicle that comes first by name.
        other: the other.
        shared: voxels of which both claim the same.
        by_chance: how many would coincide by chance; 0 of copies.
        least: claims of who claims less; of copies the voxels that both have measured.
    """

    one: str
    other: str
    shared: int
    by_chance: float
    least: int

    @property
    def is_copy(self) -> bool:
        """Whether it tells of the same measurements."""
        return self.shared > 0 and self.by_chance == 0.0


@dataclass(frozen=True, slots=True)
class LoneWord:
    """A vehicle that is not believed alone, on a day (days since 1970) or in general (0), since when, UTC, and why."""

    vehicle: str
    day: int
    since_ns: int
    why: str


@dataclass(frozen=True, slots=True)
class DayAlone:
    """Voxels that were changed on a vehicle's word alone, and on its word and that of others, on a day (since 1970)."""

    vehicle: str
    day: int
    alone: int
    shared: int


@dataclass(frozen=True, slots=True)
class ImpossibleSaid:
    """So many reports of a vehicle were refused because it cannot have been there: the first and the last time, UTC,
    and why, the last time.
    """

    vehicle: str
    times: int
    since_ns: int
    at_ns: int
    why: str


@dataclass(frozen=True, slots=True)
class VehiclePair:
    """Two vehicles, by name, that say the same false things: voxels of which both claim the same, and how many would be
    by chance.
    """

    one: str
    other: str
    shared: int
    by_chance: float


@dataclass(frozen=True, slots=True)
class VehicleTrust:
    """What is known of a vehicle's word.

    Attributes:
        vehicle: its pseudonym.
        tested: of its newest tiles so many were judged by others, ...
        refuted: ... and it was contradicted in so many.
        claims: changes that it claimed there, ...
        refuted_claims: ... and how many of them were contradicted.
        quotes: voxels that it called unchanged, ...
        refuted_quotes: ... and how many of them had changed.
        is_quarantined: its reports do not count.
        by: "agreement" or "operator"; "": it is not quarantined.
        why: reason in a line.
        since_ns: when it was quarantined, UTC; 0: it is not.
        seen: voxels of those tiles that it has seen and others could judge; 0: not known.
    """

    vehicle: str
    tested: int
    refuted: int
    claims: int
    refuted_claims: int
    quotes: int
    refuted_quotes: int
    is_quarantined: bool
    by: str = ""
    why: str = ""
    since_ns: int = 0
    seen: int = 0


@dataclass(frozen=True, slots=True)
class CourseSaid:
    """Where a vehicle drives in its own frame, as its report says: what its LiDAR's mount is turned by, rad."""

    report_id: str
    vehicle: str
    at_ns: int
    turn_rad: float
    sigma_rad: float


@dataclass(frozen=True, slots=True)
class VehicleAccount:
    """What shift tests and courses say about one vehicle.

    Attributes:
        vehicle: its pseudonym.
        tested: of its newest reports on tiles so many could be tested, ...
        explained: ... and so many are explained by a shift.
        length_m: mean length of these shifts.
        length_sd_m: their standard deviation: a mount or a clock errs alike, again and again.
        turn_rad: mean turn.
        forward_m: mean along the vehicle's axes, of the tests that tell it; None: none does.
        left_m: the same.
        is_shifted: its reports are shifted again and again; what it alone claims waits.
        course_tiles: tiles of the newest reports that tell its course, ...
        course_rad: ... which on the mean runs so much to the left of its heading, ...
        course_sigma_rad: ... known to so much.
        is_turned: its LiDAR's mount is turned against what it believes. Its points lie where they should all the same,
            as they were matched with the map: only its heading is wrong.
    """

    vehicle: str
    tested: int
    explained: int
    length_m: float
    length_sd_m: float
    turn_rad: float
    forward_m: float | None
    left_m: float | None
    is_shifted: bool
    course_tiles: int = 0
    course_rad: float = 0.0
    course_sigma_rad: float = 0.0
    is_turned: bool = False

    @property
    def is_named(self) -> bool:
        """Whether somebody should look at the vehicle."""
        return self.is_shifted or self.is_turned


@dataclass(frozen=True, slots=True)
class WaitingChange:
    """What one vehicle claims about a tile and nobody has confirmed, as a store keeps it: `Unconfirmed`, and where.

    `since_ns` is when the first of the vehicle's reports that claim it was received.
    """

    layer: str
    tile: TileId
    vehicle: str
    reason: WaitingReason
    voxels: int
    seen: int
    since_ns: int


@dataclass(frozen=True, slots=True)
class Publication:
    """A merge's result: the new content, or None when nothing visible has changed.

    `report_ids` are the reports that it comes from. `voxel_reports` names them for each changed voxel, or by the id of
    each changed feature, when known. `waiting` is what the reports claim and the content has not; None: as before.
    `shift_tests`, `agreement_tests` and `courses` are those of this tile's reports, which add to the accounts of their
    vehicles, as `standings` and `coincidences` do. `basis` says what of the journal the content was made of, `memory`
    what the windows `closed` have come to, where any was folded. `trial`: who gets the version first; None: it is
    everybody's at once.
    The store numbers versions itself: it publishes `base_version + 1`, whatever `tile.version` says.
    """

    claim: Claim
    base_version: int
    tile: AnyTile | None
    reason: VersionKind = "merged"
    report_ids: tuple[str, ...] = ()
    voxel_reports: Mapping[int, tuple[str, ...]] = field(default_factory=dict)
    waiting: tuple[Unconfirmed, ...] | None = None
    shift_tests: tuple[ShiftTest, ...] = ()
    agreement_tests: tuple[AgreementTest, ...] = ()
    courses: tuple[CourseSaid, ...] = ()
    standings: tuple[VehicleStanding, ...] = ()
    coincidences: tuple[Coincidence, ...] = ()
    basis: Basis | None = None
    memory: StoredMemory | None = None
    closed: tuple[int, ...] = ()
    trial: TrialTerms | None = None

    def __post_init__(self) -> None:
        if self.tile is not None and self.tile.tile_id != self.claim.tile:
            raise StoreError(f"publication of {self.tile.tile_id.path} under a claim of {self.claim.tile.path}")
        if self.tile is not None:
            check_fits(self.tile, self.claim.layer)
        if self.base_version < 0:
            raise StoreError(f"base_version {self.base_version} is negative")


@dataclass(frozen=True, slots=True)
class PublishResult:
    """`published`: `version` is new. `unchanged`: it stays. `stale`: refused, `version` is the head's; claim again."""

    status: PublishStatus
    version: int


@dataclass(frozen=True, slots=True)
class Notice:
    """A version whose update notice has not been confirmed by `announced`."""

    layer: str
    tile: TileId
    version: int


@dataclass(frozen=True, slots=True)
class Quarantined:
    """A refused message: when it came last, from where, why it was refused, how often, and its bytes."""

    received_ns: int
    source: str
    reason: str
    times: int
    body: bytes = field(repr=False)


@dataclass(frozen=True, slots=True)
class GcResult:
    """What retention has removed."""

    versions: int
    bytes: int


@dataclass(frozen=True, slots=True)
class StoreCounts:
    """How much a store holds. `reports` counts report ids, `report_rows` one for each tile of a report."""

    tiles: int
    versions: int
    reports: int
    report_rows: int
    waiting: int
    dirty: int
    quarantined: int
    set_aside: int = 0
