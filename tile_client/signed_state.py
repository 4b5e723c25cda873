"""Whether what a publisher has signed is one to use: it answers for it as it is, and no newer one was seen."""

import time
from typing import Protocol

from gnd.fleet_bus.errors import NotAnsweredFor, SealError
from gnd.fleet_bus.publishers import Publishers
from gnd.schemas.archive_seal import SealNumber


class SignedState(Protocol):
    """The signature of a catalog or of a list of districts."""

    @property
    def number(self) -> int:
        """How often it was signed, from 1."""

    @property
    def signed_s(self) -> int:
        """When it was signed, POSIX seconds."""

    @property
    def signer(self) -> bytes:
        """Id of the certificate, 8 bytes."""

    @property
    def signature(self) -> bytes:
        """R and s, 32 bytes each."""

    @property
    def order(self) -> SealNumber:
        """Which state it is."""


class RefusedStateError(Exception):
    """Why a catalog or a list is not used, in a word and in a sentence."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


def check_answered(publishers: Publishers, signed: SignedState, text: bytes, named: str) -> None:
    """`RefusedStateError` where none of these publishers has signed a text as it is.

    Args:
        publishers: whose signature counts.
        signed: the signature.
        text: what must have been signed.
        named: how much it names, for the message.
    """
    try:
        publishers.check(signed.signer, signed.signed_s, text, signed.signature)
    except NotAnsweredFor as error:
        raise RefusedStateError(error.why, f"{error}; {named} are named") from error
    except SealError as error:
        raise RefusedStateError("unknown", str(error)) from error


def check_order(signed: SignedState, newest: SealNumber, oldest_s: float | None, of: str = "") -> float:
    """How long ago a state was signed, s; `RefusedStateError` where it is older than was seen, or than is wanted.

    Args:
        signed: its signature.
        newest: the newest state that was seen.
        oldest_s: the greatest age that is wanted, s; None: any.
        of: of what it is, for the message.
    """
    if signed.order < newest:
        raise RefusedStateError(
            "older",
            f"number {signed.number}{of} was signed {newest.signed_s - signed.signed_s} s before number"
            f" {newest.number}, which was seen before",
        )
    age_s = time.time() - signed.signed_s
    if oldest_s is not None and age_s > oldest_s:
        raise RefusedStateError(
            "too old",
            f"number {signed.number}{of} was signed {age_s / 3600:.1f} h ago, at most {oldest_s / 3600:.1f} h are"
            " wanted: newer ones are withheld, or no shard has run since",
        )
    return age_s
