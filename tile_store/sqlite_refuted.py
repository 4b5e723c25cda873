"""Reports that other vehicles contradict, in SQLite: inside the caller's transaction, derived from `shift_test`."""

from collections.abc import Iterable
from typing import Any, Final

import apsw

from tile_store.sqlite_connection import change, fetch

REFUTED_TESTS: Final = 3
"""A report is refuted after so many tiles in which it stands alone against others, ..."""
REFUTED_SHARE: Final = 0.5
"""... if they are so many of all that could be compared."""


def refuted(c: apsw.Connection, layer: str) -> frozenset[str]:
    """The refuted reports of a layer."""
    limits = {"layer": layer, "least": REFUTED_TESTS, "share": REFUTED_SHARE}
    return frozenset(report for (report,) in fetch(c, "refuted_reports", limits))


def merge_again(c: apsw.Connection, layer: str, reports: Iterable[str], timing: dict[str, Any]) -> None:
    """The tiles of reports that are refuted now, or no longer, wait to be merged again."""
    for report in sorted(reports):
        for (tile,) in fetch(c, "tiles_of_report", {"layer": layer, "report_id": report}):
            change(c, "mark_dirty", {"layer": layer, "tile": tile} | timing)
