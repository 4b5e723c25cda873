"""Settings of a shard; the defaults run."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from gnd.cloud_merger.checking import IngestLimits
from gnd.cloud_merger.confirmation import ConfirmationParameters
from gnd.cloud_merger.errors import MergerError
from gnd.cloud_merger.features.check import FeatureLimits
from gnd.cloud_merger.features.parameters import FeatureMergeParameters
from gnd.cloud_merger.merge import MergeParameters
from gnd.cloud_merger.shift import ShiftParameters
from gnd.cloud_merger.waiting import WaitingLimits
from gnd.cloud_merger.wants import WantParameters
from gnd.fleet_bus.config import DEFAULT_ENDPOINT
from gnd.gnd_map.config import from_mapping
from gnd.tile_store.values import DEFAULT_CODEC, StoreConfig, lattice_named

_SHARD_ID: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@dataclass(frozen=True, slots=True)
class ShardConfig:
    """One merger shard.

    Attributes:
        shard_id: its name among the shards; each running shard needs its own.
        store_path: file of the store, which all shards of a machine share.
        connect: endpoints of routers.
        bus_lease_ms: how long a silent shard counts as alive; 0: the bus's own.
        merge: how statements become changes.
        confirmation: what a single vehicle may change.
        shift: when changes are an error of the vehicle's poses.
        features: how statements become changes in feature layers.
        ingest: which reports are refused.
        feature_limits: which reports about features are refused.
        want: which Gaussians of reports in short are asked for.
        waiting: for how many reports, and how long, Gaussians that were asked for are not asked of others.
        store: batching of the store.
        codec: how finely the Gaussians of tiles are rounded that no base map holds ("float": not at all); all shards of
            a store use the same. Other tiles stay as fine as their base.
        tiles_at_once: tiles claimed together; each is published as soon as it is merged.
        expanders: threads that look at what was acknowledged.
        uploads_at_once: uploads that such a thread claims together.
        lease_s: how long a claim holds that nobody renews: its shard has died or hangs.
        poll_s: how often to look for tiles and notices when nothing arrives here.
        max_attempts: a tile whose merge fails so often is set aside; so is an upload that cannot be read so often.
        retry_s: pause before a failed tile or upload is tried again, times the number of attempts.
        announce_at_once: publish a notice for at most so many versions in one round.
    """

    shard_id: str = "merger-1"
    store_path: Path = Path("map.sqlite")
    connect: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    bus_lease_ms: int = 0
    merge: MergeParameters = field(default_factory=MergeParameters)
    confirmation: ConfirmationParameters = field(default_factory=ConfirmationParameters)
    shift: ShiftParameters = field(default_factory=ShiftParameters)
    features: FeatureMergeParameters = field(default_factory=FeatureMergeParameters)
    ingest: IngestLimits = field(default_factory=IngestLimits)
    feature_limits: FeatureLimits = field(default_factory=FeatureLimits)
    want: WantParameters = field(default_factory=WantParameters)
    waiting: WaitingLimits = field(default_factory=WaitingLimits)
    store: StoreConfig = field(default_factory=StoreConfig)
    codec: str = DEFAULT_CODEC
    tiles_at_once: int = 16
    expanders: int = 2
    uploads_at_once: int = 8
    lease_s: float = 10.0
    poll_s: float = 0.2
    max_attempts: int = 5
    retry_s: float = 0.5
    announce_at_once: int = 256

    def __post_init__(self) -> None:
        if not _SHARD_ID.fullmatch(self.shard_id):
            raise MergerError(f"shard id {self.shard_id!r} must be 1 to 64 of letters, digits, '.', '_', '-'")
        lattice_named(self.codec)
        at_least_one = ("tiles_at_once", "expanders", "uploads_at_once", "max_attempts", "announce_at_once")
        if min(getattr(self, name) for name in at_least_one) < 1:
            raise MergerError(f"{', '.join(at_least_one)} must be at least 1")
        if min(self.lease_s, self.poll_s) <= 0 or self.retry_s < 0:
            raise MergerError(
                f"lease_s {self.lease_s} and poll_s {self.poll_s} must be positive, retry_s {self.retry_s} >= 0"
            )

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> "ShardConfig":
        """From plain values, as read from TOML; `ConfigError` for an unknown key."""
        return from_mapping(cls, mapping, where="merger")
