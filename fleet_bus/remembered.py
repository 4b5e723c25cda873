"""Certificates of others, kept in a file beside the own one: a new start need not ask for what it knew before.

The file is trusted with nothing. A certificate that is found there is checked like one that has just come, against the
authority, the time and the list of the revoked, when somebody seals with it; what fails is forgotten and asked for. Who
may not write beside his certificate remembers nothing.
"""

import logging
import threading
import time
from collections import OrderedDict
from pathlib import Path
from typing import Final

from gnd.fleet_bus.errors import SealError
from gnd.fleet_bus.seals import MAX_CHAIN_BYTES, certificate_id

_LOG = logging.getLogger(__name__)
FILE: Final = "known_certificates.bin"
MOST_BYTES: Final = 1 << 23
"""Of the file: some 12,000 certificates. At the next start the newest half is kept."""
_LENGTH_BYTES: Final = 2


class RememberedChains:
    """Chains of certificates by the short id of the first one. Safe in several threads.

    Args:
        path: of the file; it need not be there.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._lock, self._may_write = path, threading.Lock(), True
        self._chains: OrderedDict[bytes, bytes] = OrderedDict()
        self._size = 0
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            return
        except OSError as error:
            _LOG.info("%s is not read: %s", path, error)
            return
        self._chains = read_chains(data if len(data) <= MOST_BYTES else _newer_half(data))
        kept = _file_of(self._chains)
        self._size = len(kept)
        if kept != data:
            self._write("wb", kept)

    def get(self, wanted: bytes) -> bytes | None:
        """The chain of that id."""
        with self._lock:
            return self._chains.get(wanted)

    def add(self, wanted: bytes, chain: bytes) -> None:
        """Remember a chain, and write it down."""
        with self._lock:
            if self._chains.get(wanted) == chain:
                return
            self._chains[wanted] = chain
            if len(chain) <= MAX_CHAIN_BYTES and self._size < MOST_BYTES:
                self._write("ab", _entry(chain))
                self._size += len(chain) + _LENGTH_BYTES

    def drop(self, wanted: bytes) -> None:
        """Forget a chain until it comes again."""
        with self._lock:
            self._chains.pop(wanted, None)

    def _write(self, mode: str, data: bytes) -> None:
        if not self._may_write:
            return
        try:
            with self._path.open(mode) as file:
                file.write(data)
        except OSError as error:
            self._may_write = False
            _LOG.info("certificates of others are not kept in %s: %s", self._path, error)


def read_chains(data: bytes) -> "OrderedDict[bytes, bytes]":
    """The chains in a file by their ids, without those that have ended. What cannot be read is left out: it is asked
    for again.
    """
    from gnd.fleet_bus.seal_keys import certificates_of

    found: OrderedDict[bytes, bytes] = OrderedDict()
    now_s = time.time()
    at = 0
    while at + _LENGTH_BYTES < len(data):
        begin = at + _LENGTH_BYTES
        at = begin + int.from_bytes(data[at:begin], "little")
        chain = data[begin:at]
        try:
            certificates = certificates_of(chain)
            ends_s = min(one.not_valid_after_utc.timestamp() for one in certificates)
        except (SealError, ValueError):
            continue
        if ends_s > now_s:
            own = chain[2 : 2 + int.from_bytes(chain[:2], "little")]
            found[certificate_id(own)] = chain
    return found


def _newer_half(data: bytes) -> bytes:
    """From the chain on that reaches into the second half."""
    at = end = 0
    while end <= len(data) // 2:
        at, end = end, end + _LENGTH_BYTES + int.from_bytes(data[end : end + _LENGTH_BYTES], "little")
    return data[at:]


def _entry(chain: bytes) -> bytes:
    return len(chain).to_bytes(_LENGTH_BYTES, "little") + chain


def _file_of(chains: "OrderedDict[bytes, bytes]") -> bytes:
    return b"".join(map(_entry, chains.values()))
