"""The signed list of a layer's districts in SQL: each function runs inside the caller's transaction.

A publication that makes the first tile of a district adds the district and signs the list; all others leave it alone,
so that shards which publish in different districts do not wait for each other. Who meets another writer looks again.
"""

from collections.abc import Iterable, Sequence
from hashlib import sha256
from typing import Any, Final

import numpy as np

from gnd.fleet_bus.errors import SealError
from gnd.fleet_bus.publishers import Publishers
from gnd.gnd_map.tile_id import TILES_OF_DISTRICT, District
from gnd.schemas.district_list import DistrictList, DistrictsHead, DistrictsSignature, district_of, packed
from gnd.schemas.errors import SchemaError
from gnd.schemas.wire import VEHICLE_PATTERN
from gnd.tile_store.connection import SqlConnection, change, fetch, post
from gnd.tile_store.districts import DEFAULT_REGION
from gnd.tile_store.errors import StoreBusy
from gnd.tile_store.signing import Signing, who_answers

TRIES: Final = 16


def region_of(c: SqlConnection) -> str:
    """The name of the store's part of the map, as lists bear it."""
    rows = fetch(c, "region_of_store")
    name = rows[0][0] if rows else DEFAULT_REGION
    return name if VEHICLE_PATTERN.fullmatch(name) else sha256(name.encode()).hexdigest()[:16]


def list_of(c: SqlConnection, layer: str) -> DistrictList | None:
    """What is signed of a layer's districts; None: nothing."""
    rows = fetch(c, "district_list", {"layer": layer})
    if not rows:
        return None
    region, districts, number, signed_s, signer, signature = rows[0]
    try:
        numbers = tuple(np.frombuffer(bytes(districts), "<u8").tolist())
        head = DistrictsHead.of(layer, region, numbers)
        return DistrictList(head, DistrictsSignature(number, signed_s, bytes(signer), bytes(signature)), numbers)
    except (SchemaError, ValueError):  # none that anybody can have made: as good as unsigned
        return None


def who_signed_list(c: SqlConnection, publishers: Publishers, told: DistrictList) -> str:
    """Role and name of the publisher that answers for a list.

    Raises:
        SealError: nobody does who may; why.
    """
    return who_answers(c, publishers, told.signature, told.text)


def is_good(c: SqlConnection, publishers: Publishers, told: DistrictList) -> bool:
    """Whether one of our publishers answers for a list."""
    try:
        who_signed_list(c, publishers, told)
    except SealError:
        return False
    return True


def add(c: SqlConnection, signing: Signing, layer: str, district: District) -> None:
    """Sign that a layer has one more district.

    Where nobody answers for those that there are, it is left to who looks at all of them (`district_lists`): publishing
    goes on.

    Raises:
        NotPublished: the certificate of this process has ended.
        StoreBusy: others changed the list again and again.
    """
    number, first = district.first_morton // TILES_OF_DISTRICT, district.first_morton
    place = {"layer": layer, "first": first, "end": first + TILES_OF_DISTRICT}
    for _ in range(TRIES):
        are_others, held = bool(fetch(c, "any_other_head", place)), number_of_list(c, layer)
        before = list_of(c, layer)
        if before is None and (are_others or held):
            return
        if before is not None and (number in (before.numbers or ()) or not is_good(c, signing.publishers, before)):
            return
        numbers = (number,) if before is None else sorted((*(before.numbers or ()), number))
        if put(c, signing, layer, numbers, before, held):
            return
    raise StoreBusy(f"the list of districts of layer {layer} was changed by others {TRIES} times; try again")


def put(
    c: SqlConnection, signing: Signing, layer: str, numbers: Sequence[int], before: DistrictList | None, held: int
) -> bool:
    """Sign a list, and keep it in the place of what is there; False: another writer was faster.

    Args:
        c: in a transaction.
        signing: who signs.
        layer: of the map.
        numbers: of the districts, ascending.
        before: the list that it goes on from; None: its number and time begin anew.
        held: `number_of_list`, read before that list.
    """
    head = DistrictsHead.of(layer, region_of(c), numbers)
    signature, chain = signing.sign_districts(head, None if before is None else before.signature)
    post(c, "put_publisher", {"signer": signature.signer, "chain": chain, "since_s": signature.signed_s})
    return keep(c, DistrictList(head, signature, tuple(numbers)), held)


def keep(c: SqlConnection, told: DistrictList, held: int) -> bool:
    """Keep a list that somebody has signed, instead of that of number `held`; False: another writer was faster."""
    signed = told.signature
    row: dict[str, Any] = {
        "layer": told.head.layer,
        "region": told.head.region,
        "districts": packed(told.numbers or ()),
    }
    row |= {"number": signed.number, "signed_s": signed.signed_s, "signer": signed.signer}
    row |= {"signature": signed.signature}
    if not held:
        return change(c, "insert_district_list", row) == 1
    return change(c, "swap_district_list", row | {"held": held}) == 1


def number_of_list(c: SqlConnection, layer: str) -> int:
    """The number of the row that is there, whether it is a list or not; 0: none."""
    rows = fetch(c, "number_of_list", {"layer": layer})
    return rows[0][0] if rows else 0


def numbers_there(c: SqlConnection, layer: str) -> set[int]:
    """Of the districts with tiles."""
    return {number for (number,) in fetch(c, "districts", {"layer": layer})}


def numbers_moved(c: SqlConnection) -> set[int]:
    """Of the districts that are another store's now, which this list goes on naming: so who hears this store alone
    notices that the other one is kept from him.
    """
    return {number for (number,) in fetch(c, "districts_moved_away")}


def paths(numbers: Iterable[int]) -> str:
    """Districts in a message: the first few of them."""
    some = sorted(numbers)
    return ", ".join(district_of(one).path for one in some[:3]) + (", ..." if len(some) > 3 else "")
