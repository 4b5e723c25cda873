"""Results by the very object."""

import threading

from gnd.gnd_map.by_object import ByObject


def test_each_object_is_worked_on_once_whatever_it_equals():
    held: ByObject[list[int]] = ByObject(4)
    one, same = [1, 2], [1, 2]
    first = held.of(one, lambda: [3])
    assert held.of(one, lambda: [4]) is first
    assert held.of(same, lambda: [5]) == [5]
    assert held.of(one, lambda: [6], "other key") == [6]
    assert held.of(one, lambda: [7]) is first


def test_what_was_used_longest_ago_goes_first():
    held: ByObject[int] = ByObject(2)
    a, b, c = [0], [1], [2]
    assert [held.of(thing, lambda: 1) for thing in (a, b)] == [1, 1]
    held.of(a, lambda: 2)
    held.of(c, lambda: 1)
    assert held.of(a, lambda: 3) == 1
    assert held.of(b, lambda: 4) == 4


def test_an_object_that_is_held_keeps_its_number():
    """Else another would get it, and the result of the first."""
    held: ByObject[int] = ByObject(8)
    numbers = {id_of_held(held, k) for k in range(8)}
    assert len(numbers) == 8


def id_of_held(held, k):
    thing = [k]
    held.of(thing, lambda: k)
    return id(thing)


def test_threads_may_ask_together():
    held: ByObject[int] = ByObject(16)
    things = [[k] for k in range(32)]
    wrong = []

    def ask():
        for _ in range(200):
            wrong.extend(k for k, thing in enumerate(things) if held.of(thing, lambda k=k: k) != k)

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []
