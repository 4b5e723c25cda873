"""What seals and TLS add to each message of a vehicle on a known street, and to the messages of a kilometre."""

import tempfile
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from gnd.deploy.fleet_identities import make_identities
from studies.frame.measure import Figure
from studies.security_study.kilometre import (
    HEAD,
    KILOMETRE,
    KILOMETRE_APART,
    NAME_BYTES,
    WORD,
    KilometreMessage,
    Wired,
    router,
    wired,
)

TIMES: Final = 30
_WAYS: Final = (("plain", "tcp", False), ("seals", "tcp", True), ("seals and TLS", "tls", True))
_ONE_OF_EACH: Final = tuple({one.what: one for one in reversed((*KILOMETRE, WORD, HEAD))}.values())
_KILOMETRES: Final = {
    "a kilometre with a question a district": KILOMETRE_APART,
    "a kilometre": KILOMETRE,
}
_NAMES: Final = {
    "question": "a question about the map and its answer",
    "report": "a report and its acknowledgement",
    "word": "a word to the vehicle",
    "telemetry": "a sample of telemetry",
    "head": "a question after the head of the list of districts and its answer",
}


@dataclass(frozen=True, slots=True)
class _Cost:
    """IP bytes of a message beside its payload, by what it is, over one kind of connection.

    Attributes:
        of: the middle of all tries: on a busy machine the end of a query sometimes has a packet of its own.
        mean: of all tries.
    """

    of: dict[str, float]
    mean: dict[str, float]

    @classmethod
    def from_tries(cls, tries: dict[str, list[float]]) -> "_Cost":
        """From what each try came to."""
        return cls(
            {what: float(np.median(found)) for what, found in tries.items()},
            {what: float(np.mean(found)) for what, found in tries.items()},
        )


def _kilometre(of: dict[str, float], said: tuple[KilometreMessage, ...]) -> float:
    """IP bytes of these messages, each with its own payload."""
    return sum(of[one.what] + one.up + one.down for one in said)


def run() -> list[Figure]:
    """Say each message many times over a real router: without identities, with seals alone, with TLS."""
    with tempfile.TemporaryDirectory() as folder:
        identities = make_identities(Path(folder), 1, 1)
        costs = _costs(identities)
    return [*_by_message(costs), *_by_kilometre(costs), _head(costs)]


def _costs(identities: Path) -> dict[str, _Cost]:
    """What each kind of message costs beside its payload, by kind of connection.

    All take turns: how often the end of a query leaves together with the answer depends on how busy the machine is.
    """
    of: dict[str, dict[str, list[float]]] = {name: {what: [] for what in _NAMES} for name, _, _ in _WAYS}
    with ExitStack() as stack:
        ways: dict[str, Wired] = {}
        for name, protocol, sealed in _WAYS:
            port, _ = stack.enter_context(router(protocol, identities))
            endpoint = f"{protocol}/127.0.0.1:{port}"
            ways[name] = stack.enter_context(wired(endpoint, identities if sealed else None))
            ways[name].bytes_of(KILOMETRE)  # certificates are shown, keys agreed on
        for _ in range(TIMES):
            for one in _ONE_OF_EACH:
                for name, parts in ways.items():
                    of[name][one.what].append(parts.bytes_of((one,)) - one.up - one.down)
    return {name: _Cost.from_tries(tries) for name, tries in of.items()}


def _by_message(costs: dict[str, _Cost]) -> list[Figure]:
    found = []
    for what, name in _NAMES.items():
        plain, seals, tls = (cost.of[what] for cost in costs.values())
        added = f"seals add {seals - plain:.0f} B, TLS {tls - seals:.0f} B"
        found.append(Figure(f"{name}, beside the payload, plain", plain, "B", added))
    return found


def _head(costs: dict[str, _Cost]) -> Figure:
    """What a vehicle with an identity asks every six hours, and one without never."""
    whole = costs["seals and TLS"].of["head"] + HEAD.up + HEAD.down
    return Figure("every six hours: the head of the list of districts", whole, "B", f"{whole / 6:.0f} B an hour")


def _by_kilometre(costs: dict[str, _Cost]) -> list[Figure]:
    found = []
    for name, said in _KILOMETRES.items():
        plain, seals, tls = (_kilometre(cost.of, said) for cost in costs.values())
        plain_mean, _, tls_mean = (_kilometre(cost.mean, said) for cost in costs.values())
        counted = ", ".join(f"{n} x {what}" for what, n in Counter(one.what for one in said).items())
        added = f"seals add {seals - plain:.0f} B, TLS {tls - seals:.0f} B: {100 * (tls / plain - 1):+.1f} %"
        named = tls + sum(NAME_BYTES for one in said if one.named)
        added += f"; did acks name their reports {100 * (named / plain - 1):+.1f} %"
        added += f" (by means {plain_mean:,.0f} and {tls_mean:,.0f} B: {100 * (tls_mean / plain_mean - 1):+.1f} %)"
        found += [Figure(f"{name}, plain", plain, "B", counted), Figure(f"{name}, seals and TLS", tls, "B", added)]
    return found
