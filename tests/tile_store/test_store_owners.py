"""Whose a vehicle is: from when on, written once, and kept when its name goes."""

from gnd.tile_store import sql_erase as erasing
from gnd.tile_store.sql_trust import digest_of_owner

A, B = digest_of_owner("a"), digest_of_owner("b")


def test_an_owner_holds_until_another_one_does(maker) -> None:
    for since_ns, owner in ((5, "a"), (7, "a"), (9, "b"), (9, "a"), (11, "a")):
        with maker.open() as store:  # opened anew, it remembers none
            store.note_owner("car", owner, since_ns)
    with maker.open() as store:
        assert store.owners_of(["car", "nobody"]) == {"car": ((5, A), (9, B), (11, A))}
        assert store.owners_of([]) == {}


def test_an_owner_holds_for_an_invented_name_from_the_beginning(store) -> None:
    for since_ns, owner in ((5, "a"), (9, "b")):
        store.note_owner("car", owner, since_ns)
    for _ in range(2):  # erasure is begun again after it was killed
        store.transact(lambda c, _now: erasing.own_too(c, "car", "gone-1"))
    store.transact(lambda c, _now: erasing.remove_rest(c, "car", "gone-1"))
    assert store.owners_of(["car", "gone-1"]) == {"gone-1": ((0, A), (9, B))}
