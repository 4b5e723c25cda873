"""How much one owner, or one sensor model, may decide where others look, too.

An owner of many vehicles has many votes, and a model with a defect sees the same wrong thing everywhere. So in each
voxel the votes of one owner count together at most as those of all others plus one, those of one model at most as those
of all others plus three. Where nobody else looks nothing is capped, and what all present say together weighs as much as
before against what the map holds: the fleet of one owner, all with the same LiDAR, maps its streets as ever.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.statements import Report, Statements

CAP_OWNER_BEYOND: Final = 1.0
"""Where two others deny what only vehicles of one owner claim, the change has three of five votes at most."""
CAP_MODEL_BEYOND: Final = 3.0
CAP_OWNER_VOICES: Final = 2
"""So many vehicles of an owner, at most, are heard against a vehicle of another, where three must agree."""
CAP_MODEL_VOICES: Final = 3
"""The same of a model: where two of other models deny it, it does not say who is wrong."""
CAP_OWNER_NAMES: Final = 1
"""So many vehicles of an owner are heard when it comes to naming one of another, where two must agree."""

_JUST_BELOW: Final = 1.0 - 1e-9
"""Of three votes of five, which are not more than 0.6, no rounding makes more."""

Owners = Mapping[str, tuple[tuple[int, str], ...]]
"""Of each vehicle whose owner is known: since when by the clock of the cloud, UTC ns, and whose it is; ascending."""
I64 = NDArray[np.int64]


def owner_of(report: Report, owners: Owners) -> str:
    """Whose vehicle has made a report, when it came; "": not known."""
    told = [owner for since_ns, owner in owners.get(report.vehicle, ()) if since_ns <= report.received_ns]
    return told[-1] if told else ""


def groups_of(names: Sequence[str]) -> I64:
    """(N,) a number for each name, -1 for ""."""
    number = {name: k for k, name in enumerate(sorted({name for name in names if name}))}
    return np.array([number.get(name, -1) for name in names], np.int64)


def capped(statements: Statements, owners: Owners) -> Statements:
    """The statements with the weights that count, of the window's reports; what is remembered is as it was."""
    reports, rows = statements.reports, statements.rows
    said = np.flatnonzero((rows["report"] >= 0) & (rows["report"] < len(reports)))
    if not len(said):
        return statements
    seat = np.unique(rows["voxel_id"][said], return_inverse=True)[1]
    weight = rows["weight"][said].copy()
    of_owner = groups_of([owner_of(one, owners) for one in reports])
    of_model = groups_of([one.model for one in reports])
    for group, beyond in ((of_owner, CAP_OWNER_BEYOND), (of_model, CAP_MODEL_BEYOND)):
        weight = _capped(weight, seat, group[rows["report"][said]], beyond)
    if np.array_equal(weight, rows["weight"][said]):
        return statements
    rows = rows.copy()
    rows["weight"][said] = weight
    return replace(statements, rows=rows)


def _capped(weight: NDArray[np.float64], seat: I64, group: I64, beyond: float) -> NDArray[np.float64]:
    """(M,) the weights in which no group has more than all others of its voxel and `beyond`; their sums stay."""
    numbers = np.unique(group[group >= 0])
    if len(numbers) == 0 or (len(numbers) == 1 and (group >= 0).all()):
        return weight
    total = np.bincount(seat, weights=weight)
    found = weight.copy()
    for number in numbers.tolist():
        own = group == number
        of_group = np.bincount(seat, weights=np.where(own, weight, 0.0), minlength=len(total))
        others = total - of_group
        is_over = (others > 0.0) & (of_group > others + beyond)
        if is_over.any():  # of one group at most in a voxel
            kept = np.where(is_over, _JUST_BELOW * (others + beyond) / np.where(is_over, of_group, 1.0), 1.0)
            whole = np.where(is_over, total / (2.0 * others + beyond), 1.0)
            found *= np.where(own, kept[seat], 1.0) * whole[seat]
    return found
