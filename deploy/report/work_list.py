"""The changes of a run as a list with pictures."""

from collections.abc import Iterator
from html import escape
from typing import Final

from gnd.deploy.html_page import picture, text_table
from gnd.deploy.map_export.changes import Change, ChangedVoxels
from gnd.deploy.map_export.pieces import LONGEST_M
from gnd.deploy.report.finished_run import FinishedRun
from gnd.deploy.report.pictures import MapStates, change_picture

_MOST_ROWS: Final = 500
_KINDS: Final = ("new", "deleted", "modified")


def work_list(run: FinishedRun, states: MapStates | None, pictures: int) -> str:
    """The largest changes with pictures, all of them as a table.

    Args:
        run: whose.
        states: its map.
        pictures: so many of the largest have one.
    """
    if run.changes is None:
        return '<p class="note">The list of changes could not be made; see what is missing.</p>'
    if not run.changes.changes:
        return f'<p class="note">Nothing changed that has two voxels or more. {_alone(run.changes)}</p>'
    shown = [] if states is None else list(run.changes.changes[:pictures])
    cards = "".join(_card(number, one, states) for number, one in enumerate(shown, 1) if states is not None)
    return f"<p>{_said(run.changes, len(shown))}</p>{cards}{_table(run.changes)}"


def _said(found: ChangedVoxels, pictures: int) -> str:
    counts = {what: sum(one.change == what for one in found.changes) for what in _KINDS}
    told = ", ".join(f"{count} {what}" for what, count in counts.items() if count)
    noun = "1 change" if len(found.changes) == 1 else f"{len(found.changes)} changes"
    which = "each with a picture" if pictures == len(found.changes) else f"the {pictures} largest with a picture"
    return (
        f"{noun} ({told}), {which}. Voxels that touch are one change, cut where it is longer than {LONGEST_M:.0f} m; "
        f"what is new, deleted and modified (of another shape) is told apart. {_alone(found)}"
    )


def _alone(found: ChangedVoxels) -> str:
    return f"{found.alone} changed voxels lie alone and are not listed." if found.alone else ""


def _card(number: int, change: Change, states: MapStates) -> str:
    head = f"{number}. {change.change}: {change.shape}, {_size(change)}, {change.voxels} voxels"
    return (
        f'<article class="change"><h3 id="change-{number}">{head}</h3><p class="note">{escape(_where(change))}. '
        f"{escape(_who(change))}</p>{picture(change_picture(change, states), f'Change {number} before and after')}"
        "</article>"
    )


def _size(change: Change) -> str:
    return f"{change.length_m:.1f} × {change.width_m:.1f} × {change.tall_m:.1f} m"


def _where(change: Change) -> str:
    return f"{change.lat_deg:.7f}, {change.lon_deg:.7f}; foot {change.height_m:.1f} m above the ellipsoid"


def _who(change: Change) -> str:
    if change.vehicles is None:
        return "From a survey, not from reports of vehicles."
    vehicles = "1 vehicle" if change.vehicles == 1 else f"{change.vehicles} vehicles"
    reports = "1 report" if change.reports == 1 else f"{change.reports} reports"
    sure = "" if change.confidence is None else f"; {100 * change.confidence:.0f} % of its voxels by two or more"
    return f"Said by {vehicles} in {reports}{sure}."


def _table(found: ChangedVoxels) -> str:
    rows = list(_rows(found))
    header = (
        "",
        "change",
        "shape",
        "latitude",
        "longitude",
        "size, m",
        "voxels",
        "vehicles",
        "by two or more",
        "last seen (drive's clock)",
    )
    named = "All changes" if len(rows) == len(found.changes) else f"The {len(rows)} largest of {len(found.changes)}"
    return f"<details><summary>{named} in figures</summary>{text_table(header, rows, left=3)}</details>"


def _rows(found: ChangedVoxels) -> Iterator[tuple[str, ...]]:
    for number, one in enumerate(found.changes[:_MOST_ROWS], 1):
        yield (
            str(number),
            one.change,
            one.shape,
            f"{one.lat_deg:.7f}",
            f"{one.lon_deg:.7f}",
            f"{one.length_m:.1f} × {one.width_m:.1f} × {one.tall_m:.1f}",
            str(one.voxels),
            "–" if one.vehicles is None else str(one.vehicles),
            "–" if one.confidence is None else f"{100 * one.confidence:.0f} %",
            "–" if one.last_seen is None else one.last_seen.strftime("%Y-%m-%d %H:%M:%S UTC"),
        )
