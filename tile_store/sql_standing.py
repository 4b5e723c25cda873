"""Who is believed alone, and who has one vote with others: each function runs inside the caller's transaction.

All of it is counted from what the merges of tiles say, and those do not look at who is believed alone: so it depends on
the reports, in whatever order their tiles are merged.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, Final

from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.connection import SqlConnection, change, fetch, post
from gnd.tile_store.marks import Marked, contradicted, grouped, over_cap
from gnd.tile_store.sql_accounts import NEWEST_TESTS
from gnd.tile_store.sql_inbox import merge_again
from gnd.tile_store.values import Coincidence, LoneWord, VehiclePair, VehicleStanding

ALONE_DENIED: Final = 24
"""What a vehicle alone claims waits everywhere when others deny so many of its claims, ..."""
ALONE_DENIED_SHARE: Final = 0.6
"""... and so many of those in its newest windows that somebody else could judge."""
ALONE_DAY: Final = 2000
"""So many voxels more than others confirm of it may one vehicle change alone in a day, ..."""
ALONE_DAY_OF_OWNER: Final = 0.25
"""... and the vehicles of an owner on the mean so much of that; one as much as any."""
GROUP_LEAST_SHARED: Final = 24
"""So many false claims of two vehicles must coincide, over all tiles, ..."""
GROUP_BEYOND_CHANCE: Final = 3.0
"""... so many times more than by chance, ..."""
GROUP_SHARE: Final = 0.5
"""... and so many of the claims of the one that claims less."""
IN_GENERAL: Final = 0
"""The day of those who are not believed alone on any."""
_VALUES: Final = ("at_ns", "day", "alone", "shared", "judged", "denied", "unheard")
OF_OWNER: Final = "@"
"""Before the digest of an owner whose vehicles have changed too much alone; no name of a vehicle begins so."""


def put_standings(
    c: SqlConnection,
    layer: str,
    tile: TileId,
    windows: Sequence[int],
    standings: Iterable[VehicleStanding],
    timing: Mapping[str, Any],
) -> None:
    """Enter how vehicles stand in windows of a tile, all of those of which there is anything to tell. Where that
    changes who is believed alone, the tiles in whose open windows it claims something alone are merged again.
    """
    place = {"layer": layer, "tile": tile.morton}
    rows = fetch(c, "standings_of_tile", place | {"first": min(windows)})
    before = {(row[0], row[1]): VehicleStanding(row[1], row[0], *row[2:]) for row in rows if row[0] in windows}
    now = {(one.window, one.vehicle): one for one in standings}
    for key in sorted(before.keys() | now.keys()):
        old, new = before.get(key), now.get(key)
        if old == new:
            continue
        told = place | {"window": key[0], "vehicle": key[1]}
        if new is None:
            post(c, "delete_standing", told)
        else:
            values = {name: getattr(new, name) for name in _VALUES}
            post(c, "put_standing", told | values)
        _count_alone(c, old, new, timing)
        if _denials(old) != _denials(new):
            _judge(c, key[1], timing)


def _denials(one: VehicleStanding | None) -> tuple[int, int]:
    return (0, 0) if one is None else (one.judged, one.denied)


def _count_alone(
    c: SqlConnection, old: VehicleStanding | None, new: VehicleStanding | None, timing: Mapping[str, Any]
) -> None:
    """Of the days of a vehicle what it has changed alone, and whether that is too much."""
    if old is not None and new is not None and (old.day, old.alone, old.shared) == (new.day, new.alone, new.shared):
        return
    counted = [(sign, one) for sign, one in ((-1, old), (1, new)) if one is not None]
    for sign, one in counted:
        owners = [owner for _, _, owner in fetch(c, "owner_now", {"vehicle": one.vehicle})]
        told = {"vehicle": one.vehicle, "day": one.day, "owner": owners[-1] if owners else ""}
        post(c, "add_alone", told | {"alone": sign * one.alone, "shared": sign * one.shared})
    for vehicle, day in sorted({(one.vehicle, one.day) for _, one in counted}):
        _cap(c, vehicle, day, timing)


def _cap(c: SqlConnection, vehicle: str, day: int, timing: Mapping[str, Any]) -> None:
    """Whether a vehicle, or all of its owner together, have changed too much alone on a day."""
    ((owner, *own),) = fetch(c, "alone_of_vehicle", {"vehicle": vehicle, "day": day})
    rows = fetch(c, "alone_of_owner", {"owner": owner, "day": day}) if owner else []
    of_owner = {one: counts for one, *counts in rows}
    alone, shared = (sum(counts[column] for counts in of_owner.values()) for column in (0, 1))
    is_over = alone - shared > max(ALONE_DAY, ALONE_DAY_OF_OWNER * ALONE_DAY * len(of_owner))
    together = f"{_voxels(alone, shared)} by {len(of_owner)} vehicles of its owner" if is_over else ""
    others: dict[str, list[int]] = {}
    if owner and _note(c, OF_OWNER + owner, day, together, timing):
        others = of_owner
    for one, counts in (others | {vehicle: own}).items():
        why = _voxels(*counts) if counts[0] - counts[1] > ALONE_DAY else together
        _believe_alone(c, one, day, why, timing)


def _voxels(alone: int, shared: int) -> str:
    return f"{alone} voxels changed alone on a day, {shared} with others"


def _judge(c: SqlConnection, vehicle: str, timing: Mapping[str, Any]) -> None:
    """Whether others deny so much of what a vehicle claims that it is not believed alone."""
    rows = fetch(c, "standings_of_vehicle", {"vehicle": vehicle, "n": NEWEST_TESTS})
    judged, denied = (sum(row[column] for row in rows) for column in (0, 1))
    is_denied = denied >= ALONE_DENIED and denied >= ALONE_DENIED_SHARE * judged
    why = f"others deny {denied} of {judged} claims" if is_denied else ""
    _believe_alone(c, vehicle, IN_GENERAL, why, timing)


def _believe_alone(c: SqlConnection, vehicle: str, day: int, why: str, timing: Mapping[str, Any]) -> None:
    """Let what a vehicle alone claims wait, on a day or in general, for that reason; "": let it not."""
    if _note(c, vehicle, day, why, timing):
        for layer, tile in fetch(c, "tiles_claimed_alone", {"vehicle": vehicle}):  # no other asks for the word
            merge_again(c, layer, TileId(tile), dict(timing))


def _note(c: SqlConnection, who: str, day: int, why: str, timing: Mapping[str, Any]) -> bool:
    """Write down why somebody is not believed alone, or that nothing is held against it; whether that is new."""
    known = [row[2] for row in fetch(c, "lone_words_of_vehicle", {"vehicle": who}) if row[0] == day]
    told = {"vehicle": who, "day": day}
    if why and known != [why]:
        post(c, "put_lone_word", told | {"since_ns": timing["now"], "why": why})
    elif known and not why:
        post(c, "delete_lone_word", told)
    return bool(known) != bool(why)


def merge_by_words_of_now(
    c: SqlConnection,
    layer: str,
    tile: TileId,
    named: Iterable[str],
    alone: Collection[str],
    timing: Mapping[str, Any],
) -> None:
    """Merge a tile again whose newest merge, by the words `named`, knew other words about the vehicles `alone`, which
    claim something alone there, than there are now: one that comes while a tile is merged does not know yet who will.
    """
    if not alone:
        return
    marked = Marked.of(named)
    before = marked.over_cap | {(vehicle, IN_GENERAL) for vehicle in marked.contradicted}
    now = {(vehicle, day) for vehicle, day in fetch(c, "lone_words_of_tile", {"layer": layer, "tile": tile.morton})}
    if any(vehicle in alone for vehicle, _ in before ^ now):
        merge_again(c, layer, tile, dict(timing))


def _merge_open_tiles_again(c: SqlConnection, vehicle: str, timing: Mapping[str, Any]) -> None:
    for layer, tile in fetch(c, "tiles_of_vehicle", {"vehicle": vehicle}):
        merge_again(c, layer, TileId(tile), dict(timing))


def put_coincidences(
    c: SqlConnection,
    layer: str,
    tile: TileId,
    coincidences: Iterable[Coincidence],
    judged: Iterable[str],
    timing: Mapping[str, Any],
) -> None:
    """Enter how far refuted claims in a tile coincide, of the vehicles that were judged in it now, and who has sent
    the same measurements: that stays, whatever they send later. Where it changes who has one vote with whom, the open
    tiles of those are merged again.
    """
    place, vehicles = {"layer": layer, "tile": tile.morton}, set(judged)
    now = {(one.one, one.other): one for one in coincidences}
    rows = fetch(c, "coincidences_of_tile", place) if vehicles or now else []
    held = {(row[0], row[1]): Coincidence(*row) for row in rows}
    before = {pair: one for pair, one in held.items() if pair in now or vehicles.issuperset(pair)}
    pairs = [pair for pair in sorted(before.keys() | now.keys()) if _is_other(before.get(pair), now.get(pair))]
    if not pairs:
        return
    for one, other in pairs:
        new = now.get((one, other))
        told = place | {"one": one, "other": other}
        if new is None:
            post(c, "delete_coincidence", told)
        else:
            post(c, "put_coincidence", told | {"shared": new.shared, "by_chance": new.by_chance, "least": new.least})
    known = first_of(pairs_of_groups(c))
    for one, other in pairs:
        _pair(c, one, other, timing)
    found = first_of(pairs_of_groups(c))
    for vehicle in sorted(known.keys() | found.keys()):
        if known.get(vehicle) != found.get(vehicle):
            _merge_open_tiles_again(c, vehicle, timing)


def _is_other(old: Coincidence | None, new: Coincidence | None) -> bool:
    """Whether what is known of a pair changes."""
    if old is None or not old.is_copy:
        return old != new
    return new is not None and new.is_copy and new.shared > old.shared


def _pair(c: SqlConnection, one: str, other: str, timing: Mapping[str, Any]) -> None:
    """Whether two vehicles say the same false things, over all tiles."""
    pair = {"one": one, "other": other}
    ((shared, by_chance, least),) = fetch(c, "coincidence_of_pair", pair)
    if shared >= max(GROUP_LEAST_SHARED, GROUP_BEYOND_CHANCE * by_chance, GROUP_SHARE * float(least)):
        change(c, "put_pair_of_group", pair | {"since_ns": timing["now"]})
    else:
        change(c, "delete_pair_of_group", pair)


def pairs_of_groups(c: SqlConnection) -> list[VehiclePair]:
    """Vehicles two by two whose refuted claims coincide beyond chance."""
    return [VehiclePair(one, other, int(n), float(chance)) for one, other, n, chance in fetch(c, "pairs_of_groups")]


def first_of(pairs: Iterable[VehiclePair]) -> dict[str, str]:
    """Of each vehicle in a pair the one that comes first by name among those that pairs join it to."""
    found: dict[str, str] = {}
    for pair in pairs:
        firsts = {found.get(one, one) for one in (pair.one, pair.other)}
        found |= dict.fromkeys((pair.one, pair.other), min(firsts))
        found |= {vehicle: min(firsts) for vehicle, first in found.items() if first in firsts}
    return found


def marks_of_tile(c: SqlConnection, layer: str, tile: TileId) -> frozenset[str]:
    """The words about who has reported about a tile and is not believed alone, or has one vote with others."""
    rows = fetch(c, "lone_words_of_tile", {"layer": layer, "tile": tile.morton})
    alone = (contradicted(vehicle) if day == IN_GENERAL else over_cap(vehicle, day) for vehicle, day in rows)
    first = first_of(pairs_of_groups(c))
    here = {one for (one,) in fetch(c, "vehicles_of_tile", {"layer": layer, "tile": tile.morton})} if first else set()
    together = (grouped(vehicle, first[vehicle]) for vehicle in first if vehicle in here)
    return frozenset(alone).union(together)


def lone_words(c: SqlConnection) -> list[LoneWord]:
    """Who is not believed alone, and why."""
    return [LoneWord(vehicle, day, since_ns, why) for vehicle, day, since_ns, why in fetch(c, "lone_words")]
