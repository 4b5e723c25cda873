"""Profiles of mobile links: what a vehicle's connection can carry, and the session settings that suit it."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from gnd.fleet_bus.errors import LinkError
from gnd.gnd_map.bounded import toml_table
from gnd.gnd_map.config import from_mapping
from gnd.gnd_map.errors import ConfigError

SEGMENT_BYTES: Final = 1400
"""Payload of one IP packet on a mobile link (1500 less headers and the carrier's tunnel)."""

_PROFILES_FILE: Final = Path(__file__).resolve().parent.parent / "deploy" / "links.toml"


@dataclass(frozen=True, slots=True)
class LinkProfile:
    """Rate, delay and loss of a link, with the session buffers that keep small messages prompt on it.

    Attributes:
        name: how the profile is called on the command line.
        down_bit_s: rate towards the vehicle, bit/s; infinite for a link without limits.
        up_bit_s: rate from the vehicle, bit/s.
        delay_ms: one-way delay, ms (half of a published round trip).
        loss: probability that one packet of `SEGMENT_BYTES` must be sent again, 0 … 1.
        burst_bytes: what may pass at once before the rate binds (token bucket depth), bytes.
        batch_bytes: zenoh batch size, bytes; small ones let a short message pass bulk.
        send_buffer_bytes: SO_SNDBUF of the connection, bytes; 0 leaves the kernel's own.
        lease_ms: how long a silent session stays alive, ms.
        keep_alives: so many are sent in a lease in which nothing else is; 2 is the least that keeps a session.
        rate_source: where the rates come from (publisher, year), or that they are assumed.
        delay_source: the same for the delay.
        loss_source: the same for the loss.
        jitter_ms: the one-way delay of a packet varies evenly by as much as this to either side, ms. A network that is
            really shaped (`gnd lab`) does so; the in-process pacer keeps to the mean.
        jitter_source: where the jitter comes from.
        paced: whether the session's own pacer imitates the link; not where the network itself is shaped (`gnd lab`).
    """

    name: str
    down_bit_s: float = math.inf
    up_bit_s: float = math.inf
    delay_ms: float = 0.0
    loss: float = 0.0
    burst_bytes: int = 16_384
    batch_bytes: int = 65_535
    send_buffer_bytes: int = 0
    lease_ms: int = 10_000
    keep_alives: int = 4
    rate_source: str = ""
    delay_source: str = ""
    loss_source: str = ""
    jitter_ms: float = 0.0
    jitter_source: str = ""
    paced: bool = True

    def __post_init__(self) -> None:
        if not (self.down_bit_s > 0 and self.up_bit_s > 0):
            raise LinkError(f"link {self.name}: rates must be positive, got {self.down_bit_s}/{self.up_bit_s} bit/s")
        if not (self.delay_ms >= 0 and math.isfinite(self.delay_ms)):
            raise LinkError(f"link {self.name}: delay_ms must be 0 or more, got {self.delay_ms}")
        if not 0 <= self.jitter_ms <= self.delay_ms:
            raise LinkError(
                f"link {self.name}: jitter_ms must be in 0 … delay_ms ({self.delay_ms}), got {self.jitter_ms}"
            )
        if not 0 <= self.loss < 1:
            raise LinkError(f"link {self.name}: loss must be in [0, 1), got {self.loss}")
        if not 512 <= self.batch_bytes <= 65_535:
            raise LinkError(f"link {self.name}: batch_bytes must be in 512 … 65535, got {self.batch_bytes}")
        if self.burst_bytes < 0 or self.send_buffer_bytes < 0 or self.lease_ms < 100:
            raise LinkError(f"link {self.name}: negative buffer or lease below 100 ms ({self.lease_ms} ms)")
        if not 2 <= self.keep_alives <= 16:
            raise LinkError(f"link {self.name}: keep_alives must be in 2 … 16, got {self.keep_alives}")

    @property
    def delay_s(self) -> float:
        """One-way delay, s."""
        return self.delay_ms / 1000

    @property
    def is_unlimited(self) -> bool:
        """Whether nothing has to be paced on this link."""
        return not self.paced or self._has_no_limits()

    def _has_no_limits(self) -> bool:
        return math.isinf(self.down_bit_s) and math.isinf(self.up_bit_s) and self.delay_ms == 0 and self.loss == 0

    def rate_byte_s(self, direction: str) -> float:
        """Rate of one direction ("up" or "down"), byte/s."""
        return (self.up_bit_s if direction == "up" else self.down_bit_s) / 8


UNLIMITED: Final = LinkProfile("none")


def load_link(name_or_path: str | LinkProfile, profiles_file: Path | None = None) -> LinkProfile:
    """The profile of that name, or the only profile of a TOML file of the user's own.

    Args:
        name_or_path: "none", the name of a profile in `deploy/links.toml`, `file.toml` or `file.toml:name`.
        profiles_file: TOML file that holds the named profiles; by default the one installed beside this package.

    Raises:
        LinkError: unknown name, unreadable file, malformed profile.
    """
    if isinstance(name_or_path, LinkProfile):
        return name_or_path
    if name_or_path == "none":
        return UNLIMITED
    path, name = _split(name_or_path)
    profiles = read_links(path or profiles_file or _PROFILES_FILE)
    if name is None and len(profiles) == 1:
        return next(iter(profiles.values()))
    if name not in profiles:
        raise LinkError(f"no link profile {name or name_or_path!r}; there are: none, {', '.join(profiles)}")
    return profiles[name]


def read_links(path: Path) -> dict[str, LinkProfile]:
    """All profiles of a TOML file, one table each.

    Raises:
        LinkError: the file cannot be read, or a profile is malformed.
    """
    try:
        tables = toml_table(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise LinkError(f"cannot read link profiles from {path}: {error}") from error
    return {name: _profile(name, table) for name, table in tables.items()}


def _profile(name: str, table: Any) -> LinkProfile:
    if not isinstance(table, dict):
        raise LinkError(f"link {name}: expected a table, got {table!r}")
    try:
        return from_mapping(LinkProfile, {"name": name, **table}, where=f"link {name}")
    except ConfigError as error:
        raise LinkError(str(error)) from error


def _split(text: str) -> tuple[Path | None, str | None]:
    """File and profile of "name", "file.toml" or "file.toml:name"."""
    file, separator, name = text.rpartition(".toml")
    if not separator:
        return None, text
    return Path(file + separator), name.removeprefix(":") or None
