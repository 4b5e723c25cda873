"""The range coder's kernels against a plain twin in Python's own integers: the same bytes, the same contexts after."""

import hashlib
import random
from importlib import resources

import numpy as np
import pytest

from gnd.gnd_map.codec import kernels as k
from gnd.gnd_map.codec import prior_sets
from gnd.gnd_map.codec.coding import Coder
from gnd.gnd_map.codec.prior_sets import sets_of
from gnd.gnd_map.codec.priors import FILE, Priors, priors_of
from gnd.gnd_map.errors import CodecError

FROZEN = "59f266be96f04858921f72c0eebf9769bceb723fc4746d964717212d90baab01"
FROZEN_SETS = "4c824765d25873b24c739a2004038aafc8ae130439727c15729441c12280c78d"
KNOTS = k._KNOTS


class Twin:
    """Writes decisions as the kernels do, word for word from their description, slowly."""

    def __init__(self, priors: Priors) -> None:
        places, self.weight = priors.copies()
        self.prob = [int(place) >> 8 for place in places]
        self.seen = [int(place) & 255 for place in places]
        self.low, self.high, self.out = 0, 2**32 - 1, bytearray()

    def write(self, p: int, bit: int) -> None:
        span = self.high - self.low
        middle = self.low + (span // 65536) * p + (span % 65536) * p // 65536
        self.low, self.high = (self.low, middle) if bit else (middle + 1, self.high)
        while self.low >> 24 == self.high >> 24:
            self.out.append(self.high >> 24)
            self.low, self.high = self.low << 8 & 0xFFFFFFFF, self.high << 8 & 0xFFFFFFFF | 255

    def learn(self, at: int, bit: int) -> None:
        target = 65535 if bit else 0
        self.prob[at] += (target - self.prob[at]) * (131072 // (2 * self.seen[at] + 3)) // 65536
        self.seen[at] = min(self.seen[at] + 1, 250)

    def bit(self, at: int, bit: int) -> None:
        self.write(min(max(self.prob[at], 6), 65530), bit)
        self.learn(at, bit)

    def mixed(self, places: tuple[int, ...], w: int, bit: int) -> None:
        """In three contexts or in five."""
        stretched = [stretch(self.prob[at]) for at in places]
        weights = self.weight[w][: len(places)]
        d = sum(int(weight) * s for weight, s in zip(weights, stretched, strict=True)) // 65536
        p = squash(min(max(d, -2047), 2047))
        self.write(p, bit)
        for i, s in enumerate(stretched):
            self.weight[w, i] += (s * (bit * 65536 - p) * 6 + 2**19) // 2**20
        for at in places:
            self.learn(at, bit)

    def signed(self, starts: tuple[int, ...], w: int, value: int) -> None:
        """Length in ones and a zero, sign, digits from the second on: the first two in contexts of their own."""

        def write(which: int, bit: int) -> None:
            self.mixed(tuple(start + which for start in starts), w + which, bit)

        length = abs(value).bit_length()
        for j in range(min(length, 14)):
            write(j, 1)
        if length < 14:
            write(length, 0)
        if length:
            write(14, int(value < 0))
        for i in range(length - 2, -1, -1):
            capped = min(length, 6)
            which = {length - 2: 15 + capped - 2, length - 3: 15 + capped + 2}.get(i, 24)
            write(which, abs(value) >> i & 1)

    def plain(self, at: int, value: int) -> None:
        length = abs(value).bit_length()
        for j in range(length):
            self.bit(at + j, 1)
        self.bit(at + length, 0)
        for i in range(length - 2, -1, -1):
            self.bit(at + 34 + min(length, 32), abs(value) >> i & 1)
        if length:
            self.bit(at + 33, int(value < 0))


def squash(d: int) -> int:
    at, part = divmod(d + 2048, 64)
    return (KNOTS[at] * (64 - part) + KNOTS[min(at + 1, 64)] * part + 32) // 64


def stretch(prob: int) -> int:
    """The smallest d whose squash reaches the middle of the probability's step of 16."""
    middle = prob // 16 * 16 + 8
    return next((d for d in range(-2048, 2048) if squash(d) >= middle), 2048)


@pytest.mark.parametrize("seed", range(3))
def test_the_kernels_write_what_the_twin_writes(seed: int) -> None:
    rng, priors = random.Random(seed), priors_of("tile-standard")
    coder, twin = Coder.writing(priors, 4096), Twin(priors)
    for _ in range(300):
        at = tuple(rng.sample(range(4000), 3))
        if rng.random() < 0.5:
            bit = int(rng.random() < 0.3)
            k.code_mixed(coder.state, *at, 5, bit)
            twin.mixed(at, 5, bit)
        else:
            value = int(rng.gauss(0.0, 10.0 ** rng.randrange(6)))
            coder.number(at[0], value)
            twin.plain(at[0], value)
    body = coder.finish()[:-2]
    assert body[: len(twin.out)] == bytes(twin.out)
    assert len(body) - len(twin.out) <= 4
    tail = int.from_bytes(body[len(twin.out) :].ljust(4, b"\0"), "big")
    assert twin.low <= tail <= twin.high
    assert [int(place) >> 8 for place in coder.state[2]] == twin.prob
    np.testing.assert_array_equal(coder.state[3], twin.weight)


@pytest.mark.parametrize("number", [0, 2])
def test_numbers_in_five_contexts_are_what_the_twin_writes(number: int) -> None:
    rng, priors = random.Random(number), sets_of("standard")[number]
    coder, twin, values = Coder.writing(priors, 4096, five=True), Twin(priors), []
    for _ in range(150):
        a, b, c, d, e = rng.sample(range(0, 40_000, k.WIDTH), 5)
        values.append(((a, b, c, d, e), int(rng.gauss(0.0, 10.0 ** rng.randrange(4)))))
        k.code_signed_5(coder.state, values[-1][0], 300, values[-1][1])
        twin.signed(values[-1][0], 300, values[-1][1])
    message = coder.finish()
    body = message[:-2]
    assert body[: len(twin.out)] == bytes(twin.out)
    assert twin.low <= int.from_bytes(body[len(twin.out) :].ljust(4, b"\0"), "big") <= twin.high
    assert [int(place) >> 8 for place in coder.state[2]] == twin.prob
    np.testing.assert_array_equal(coder.state[3], twin.weight)
    reader = Coder.reading(priors, message, five=True)
    assert [k.code_signed_5(reader.state, at, 300, 0) for at, _ in values] == [value for _, value in values]


def test_what_was_written_is_read_and_the_stream_ends() -> None:
    rng, values = random.Random(9), [0, 1, -1, 2**31 - 1, -(2**31 - 1)]
    values += [int(rng.gauss(0.0, 50.0)) for _ in range(500)]
    writer = Coder.writing(Priors.flat(), 8192)
    for value in values:
        writer.number(0, value)
    body = writer.finish()
    reader = Coder.reading(Priors.flat(), body)
    assert [reader.number(0) for _ in values] == values
    reader.end()


def test_a_stream_read_too_far_or_not_to_its_end_is_refused() -> None:
    writer = Coder.writing(Priors.flat(), 64)
    for value in range(40):
        writer.number(0, value)
    body = writer.finish()
    reader = Coder.reading(Priors.flat(), body)
    with pytest.raises(CodecError, match="used"):
        reader.end()
    with pytest.raises(CodecError, match=r"truncated|31 bits"):
        _ = [reader.number(0) for _ in range(10_000)]


def test_the_frozen_start_never_changes() -> None:
    """Another file makes other bytes of the same tile: the codec ids would change their meaning."""
    files = resources.files("gnd.gnd_map.codec")
    assert hashlib.sha256(files.joinpath(FILE).read_bytes()).hexdigest() == FROZEN
    assert hashlib.sha256(files.joinpath(prior_sets.FILE).read_bytes()).hexdigest() == FROZEN_SETS


def test_sets_are_read_from_their_file_as_they_were_written() -> None:
    sets = {name: sets_of(name) for name in prior_sets.LATTICES_WITH_SETS}
    again = prior_sets.unpack(prior_sets.pack(sets))
    assert prior_sets.unpack(prior_sets.pack(sets), ("compact",)).keys() == {"compact"}
    for name, some in sets.items():
        assert 1 < len(some) <= prior_sets.MOST_SETS
        for one, other in zip(some, again[name], strict=True):
            np.testing.assert_array_equal(one.places, other.places)
            np.testing.assert_array_equal(one.weight, other.weight)
            assert one.places.min() >= 0
            assert one.places.max() < 1 << 24
