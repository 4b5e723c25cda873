"""What can go wrong on the bus.

BusError
├── BusConfigError      a setting that would lose data, or makes no sense
├── LinkError           a link profile that is unknown or malformed
├── IdentityError       an identity folder or an authority that cannot be used
├── NoRouter            nothing answers at the endpoints
├── PortInUse           the router's endpoint is taken
├── BusClosed           the bus was closed while a call was waiting
├── MessageTooLarge     over the limit that every session enforces
├── RequestFailed       no answer before the deadline
│   └── RequestRefused  the other side answered: never
├── SealError           a message whose seal is missing, does not fit or is of the wrong part
│   ├── ClocksDiffer    a seal or a certificate that does not count at this time, by the clock of here
│   └── NotAnsweredFor  a tile version that no publisher answers for
│       └── SignedAhead signed at a time that has not come, by the clock of here
├── NotMine, Refused, Busy
│                       raised by handlers: what they say to the asker
└── LedgerError         a ledger file or run folder that cannot be read
"""

from gnd.gnd_map.errors import GndError


class BusError(GndError):
    """Base of every error of this package."""


class BusConfigError(BusError):
    """A bus setting is unusable or breaks a rule that protects data."""


class LinkError(BusError):
    """A link profile is unknown or malformed."""


class IdentityError(BusError):
    """A certificate, key or list of an authority is missing, damaged, or does not belong here."""


class NoRouter(BusError):
    """No router can be reached at the configured endpoints."""


class PortInUse(BusError):
    """Another process listens at the endpoint that a router was told to open."""


class BusClosed(BusError):
    """The bus was closed before or during the call."""


class MessageTooLarge(BusError):
    """A payload exceeds `MAX_MESSAGE_BYTES`; the receiving session would drop it in silence."""


class LedgerError(BusError):
    """A ledger or a run folder cannot be read."""


class RequestFailed(BusError):
    """A request got no usable answer before its deadline.

    Attributes:
        key: key expression that was asked.
        attempts: how often the request was sent.
        cause: what happened at the last attempt.
        retry_after_s: how long the other side, being busy, asked to wait, s; 0: it did not.
    """

    def __init__(self, key: str, attempts: int, cause: str, retry_after_s: float = 0.0) -> None:
        super().__init__(f"request to {key} failed after {attempts} attempts, last: {cause}")
        self.key, self.attempts, self.cause, self.retry_after_s = key, attempts, cause, retry_after_s


class RequestRefused(RequestFailed):
    """The handler refused the request for good, so that retrying is useless."""


class SealError(BusError):
    """A message is not sealed, or not by who may say it; a certificate is not one of the authority."""


class ClocksDiffer(SealError):
    """A seal or a certificate that does not count at this time, by the clock of here: one of two clocks may be wrong,
    and then it counts later.
    """


class NotAnsweredFor(SealError):
    """A tile version that no publisher answers for.

    Attributes:
        why: unsigned, wrong (the signature does not fit), revoked (its signer's certificate was), expired (it did not
            hold when it was signed), foreign (of another authority or role) or unknown (nobody shows the certificate).
    """

    def __init__(self, why: str, text: str) -> None:
        super().__init__(text)
        self.why = why


class SignedAhead(NotAnsweredFor):
    """A version that was signed at a time that has not come, by the clock of here: one of two clocks is wrong."""


class NotMine(BusError):
    """Raised by a handler that leaves the request to others: it does not reply at all."""


class Refused(BusError):
    """Raised by a handler to say that the request can never succeed; the asker gets `RequestRefused` at once."""


class Busy(BusError):
    """Raised by a handler that has no room for the request now; the asker waits that long, and asks again.

    Attributes:
        retry_after_s: how long to wait at least, s.
        reason: a word for the counters.
    """

    def __init__(self, text: str, retry_after_s: float, reason: str) -> None:
        super().__init__(text)
        self.retry_after_s, self.reason = retry_after_s, reason
