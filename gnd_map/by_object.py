"""What was computed of the objects used last, found again by the very object: nothing is hashed or compared."""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from threading import Lock
from typing import Any, Generic, TypeVar

T = TypeVar("T")


class ByObject(Generic[T]):
    """Results of a pure function of immutable objects. Safe in several threads.

    Args:
        most: results to keep; those used longest ago go first.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._held: OrderedDict[tuple[int, Hashable], tuple[Any, T]] = OrderedDict()
        self._lock = Lock()

    def of(self, thing: object, make: Callable[[], T], key: Hashable = None) -> T:
        """What `make` gives for this object (and this key, where it gives several)."""
        place = id(thing), key
        with self._lock:
            if place in self._held:
                self._held.move_to_end(place)
                return self._held[place][1]
        found = make()
        with self._lock:
            self._held[place] = thing, found  # held, so that no other object gets its id
            if len(self._held) > self._most:
                self._held.popitem(last=False)
        return found
