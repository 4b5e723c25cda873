"""How long a store keeps what counts no more: old versions, old reports, old refused messages."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol, TypeVar

from gnd.tile_store.connection import Lock, SqlConnection, change, fetch
from gnd.tile_store.errors import StoreError
from gnd.tile_store.values import GcResult

T = TypeVar("T")
NS_A_DAY: Final = 86_400_000_000_000
QUARANTINE: Final[Lock] = ("quarantine",)
"""One writer at a time refuses messages: the bound on what is kept is one for all."""
ROWS_AT_ONCE: Final = 1000  # so that reports which arrive meanwhile need not wait


class Collectable(Protocol):
    """A store that can be cleaned up."""

    def gc(self, keep_versions: int) -> GcResult:
        """See `Store.gc`."""

    def forget_uploads(self, before_ns: int) -> int:
        """See `Store.forget_uploads`."""

    def transact(self, work: Callable[[SqlConnection, int], T]) -> T:
        """Run `work(connection, now)` in one durable write transaction."""


@dataclass(frozen=True, slots=True)
class Retained:
    """What was removed."""

    versions: int = 0
    version_bytes: int = 0
    reports: int = 0
    report_bytes: int = 0
    quarantined: int = 0
    quarantined_bytes: int = 0
    uploads: int = 0


def retain(
    store: Collectable,
    keep_versions: int | None = None,
    keep_days: float | None = None,
    quarantine_mb: float | None = None,
    *,
    folded: bool = False,
) -> Retained:
    """Remove what is beyond the bounds; None: no bound.

    Reports that still count stay however old they are, and so do the epochs and what those reports cite. A report that
    was removed and comes once more is taken for a new one.

    Args:
        store: in use or not.
        keep_versions: so many of the newest versions of each tile stay.
        keep_days: reports that count no more and refused messages stay so long after receipt, and so long what is known
            of vehicles' places and of how they stood.
        quarantine_mb: of the newest refused messages so much stays.
        folded: reports that are folded into the memory of their tile count no more, either: the map stays as it is, but
            the versions made of them cannot be computed anew.
    """
    if (keep_days is not None and keep_days < 0) or (quarantine_mb is not None and quarantine_mb < 0):
        raise StoreError(f"keep days {keep_days} and quarantine {quarantine_mb} MB must not be negative")
    reports: list[int] = []
    refused: list[int] = []
    uploads = 0
    if keep_days is not None:
        days_ns = round(keep_days * NS_A_DAY)
        uploads = store.forget_uploads(store.transact(lambda _c, now: now - days_ns))
        reports += _older_than(store, "forget_reports", keep_days, folded=folded)
        refused += _older_than(store, "forget_old_quarantined", keep_days)
        store.transact(lambda c, now: _forget_vehicles(c, now - days_ns))
    trimmed = (0, 0)
    if quarantine_mb is not None:
        trimmed = store.transact(lambda c, _now: trim_quarantine(c, round(quarantine_mb * 1e6)))
    versions = GcResult(0, 0) if keep_versions is None else store.gc(keep_versions)  # after the reports that cite them
    return Retained(
        versions.versions,
        versions.bytes,
        len(reports),
        sum(reports),
        len(refused) + trimmed[0],
        sum(refused) + trimmed[1],
        uploads,
    )


def trim_quarantine(c: SqlConnection, max_bytes: int) -> tuple[int, int]:
    """Remove the oldest refused messages until they are within a bound; how many and how many bytes went."""
    before = fetch(c, "quarantine_size")[0]
    while fetch(c, "quarantine_size")[0][1] > max_bytes and change(c, "forget_quarantined", {}):
        pass
    after = fetch(c, "quarantine_size")[0]
    return before[0] - after[0], before[1] - after[1]


def _forget_vehicles(c: SqlConnection, before_ns: int) -> None:
    """What is known of vehicles since then: how they stood, what they changed alone, where they were. Who is not
    believed alone stays so.
    """
    for what in ("standings", "days_alone", "old_places", "impossible"):
        change(c, f"forget_{what}", {"before": before_ns})


def _older_than(store: Collectable, statement: str, days: float, **more: bool) -> list[int]:
    sizes: list[int] = []
    while True:
        page = store.transact(
            lambda c, now: fetch(c, statement, {"before": now - round(days * NS_A_DAY), "n": ROWS_AT_ONCE} | more)
        )
        sizes += [size for (size,) in page]
        if len(page) < ROWS_AT_ONCE:
            return sizes
