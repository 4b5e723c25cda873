"""A stream of decisions: the coder's state with its contexts, from its frozen start to its bytes."""

import zlib
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import I32, I64
from gnd.gnd_map.codec import kernels as k
from gnd.gnd_map.codec.priors import Priors
from gnd.gnd_map.errors import CodecError

CHECK_BYTES: Final = 2
_HALF: Final = 1 << 15
State = tuple[I64, npt.NDArray[np.uint8], I32, I64]


@dataclass(slots=True)
class Coder:
    """One stream, being written or read.

    Attributes:
        state: what the kernels take.
        volume: voxels of its boxes so far.
        five: whether the numbers of voxels are coded in five contexts, else in three.
    """

    state: State
    volume: int = 0
    five: bool = False

    @classmethod
    def writing(cls, priors: Priors, room: int, *, five: bool = False) -> "Coder":
        """A stream to write, with room for so many bytes."""
        coder = np.zeros(k.SLOTS, np.int64)
        coder[k.HIGH] = 0xFFFFFFFF
        return cls((coder, np.zeros(room, np.uint8), *priors.copies()), five=five)

    @classmethod
    def reading(cls, priors: Priors, body: bytes, head_bytes: int = 0, *, five: bool = False) -> "Coder":
        """A stream to read: `finish` of another coder, with a head of so many bytes.

        Raises:
            CodecError: too short, or its checksum is wrong.
        """
        if len(body) < head_bytes + CHECK_BYTES:
            raise CodecError(f"{len(body)} bytes, fewer than the {head_bytes + CHECK_BYTES} of head and checksum")
        data, check = body[:-CHECK_BYTES], body[-CHECK_BYTES:]
        if checksum(data) != check:
            raise CodecError(f"{len(body)} bytes with checksum {check.hex()}, computed {checksum(data).hex()}: damaged")
        return cls.over(priors, data[head_bytes:], five=five)

    @classmethod
    def over(cls, priors: Priors, data: bytes, *, five: bool = False) -> "Coder":
        """A stream to read whose bytes have been checked already: `stream` of another coder."""
        coder = np.zeros(k.SLOTS, np.int64)
        coder[k.HIGH], coder[k.MODE], coder[k.AT] = 0xFFFFFFFF, 1, 4
        coder[k.CODE] = int.from_bytes(data[:4].ljust(4, b"\0"), "big")
        coder[k.OVERRUN] = max(0, 4 - len(data))
        return cls((coder, np.frombuffer(data, np.uint8).copy(), *priors.copies()), five=five)

    def check(self) -> None:
        """`CodecError` when the kernels have met what cannot be."""
        trouble = int(self.state[0][k.TROUBLE])
        if trouble:
            what = {k.FULL: "no room left", k.TOO_SHORT: "truncated", k.TOO_LARGE: "a number beyond 31 bits"}[trouble]
            raise CodecError(f"range-coded message of {len(self.state[1])} bytes: {what}")

    def number(self, at: int, value: int = 0) -> int:
        """Write a signed number below 2^31, or read one."""
        found = int(k.code_plain(self.state, at, value))
        self.check()
        return found

    def spent_bytes(self) -> tuple[float, ...]:
        """Bytes of each field of a stream that counts them, see `kernels.FIELD`; its few last bits are nobody's."""
        return tuple((self.state[0][k.SPENT :] / (8 << 16)).tolist())

    def bit(self, at: int, value: int | bool = 0) -> int:
        """Write a decision, or read one."""
        found = int(k.code_bit(self.state, at, int(value)))
        self.check()
        return found

    def finish(self, head: bytes = b"") -> bytes:
        """The head, the stream, and the checksum of both."""
        data = head + self.stream()
        return data + checksum(data)

    def stream(self) -> bytes:
        """The bytes written, as few as tell the last interval."""
        self.check()
        coder, buffer = self.state[0], self.state[1]
        return buffer[: coder[k.AT]].tobytes() + _shortest(int(coder[k.LOW]), int(coder[k.HIGH]))

    def end(self) -> None:
        """`CodecError` unless the stream that was read ends here."""
        self.check()
        coder, length = self.state[0], len(self.state[1])
        if not coder[k.AT] - 4 <= length <= coder[k.AT]:
            raise CodecError(f"range-coded message of {length} bytes, {coder[k.AT] - 4} of them used")


def checksum(data: bytes) -> bytes:
    """Two bytes of CRC-32."""
    return (zlib.crc32(data) & 0xFFFF).to_bytes(CHECK_BYTES, "little")


def _shortest(low: int, high: int) -> bytes:
    """The fewest bytes that, followed by zeros, lie between `low` and `high`."""
    for length in range(5):
        unit = 1 << (32 - 8 * length)
        value = -(-low // unit) * unit
        if value <= high and value < 1 << 32:
            return value.to_bytes(4, "big")[:length]
    raise AssertionError("four bytes tell any number of 32 bits")
