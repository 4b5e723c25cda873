"""Settings of a shard; the defaults run."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from gnd.cloud_merger.checking import IngestLimits
from gnd.cloud_merger.confirmation import ConfirmationParameters
from gnd.cloud_merger.errors import MergerError
from gnd.cloud_merger.features.parameters import FeatureMergeParameters
from gnd.cloud_merger.merge import MergeParameters
from gnd.cloud_merger.release.parameters import ReleaseParameters
from gnd.cloud_merger.wants import WantParameters
from gnd.fleet_bus.config import DEFAULT_ENDPOINT
from gnd.gnd_map.config import from_mapping
from gnd.gnd_map.settings import check_settings, setting
from gnd.schemas.feature_layer import LayerParameters, checked_layers
from gnd.tile_store.values import DEFAULT_CODEC, StoreConfig, lattice_named

MAX_ATTEMPTS: Final = 5
"""A tile whose merge fails so often is set aside; so is an upload that cannot be read so often."""
RETRY_S: Final = 0.5
"""Pause before a failed tile or upload is tried again, times the number of attempts."""
_SHARD_ID: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@dataclass(frozen=True, slots=True)
class ShardConfig:
    """One merger shard."""

    shard_id: str = setting("merger-1", "Its name among the shards; each running shard needs its own.")
    store_path: str | Path = setting(
        "map.sqlite", "The store, which all shards share: a file of their machine, or a PostgreSQL URL."
    )
    connect: tuple[str, ...] = setting((DEFAULT_ENDPOINT,), "Endpoints of routers.")
    bus_lease_ms: int = setting(0, "How long a silent shard counts as alive; 0: the bus's own.", unit="ms", least=0)
    merge: MergeParameters = setting(MergeParameters, "How statements become changes.")
    confirmation: ConfirmationParameters = setting(ConfirmationParameters, "What a single vehicle may change.")
    features: FeatureMergeParameters = setting(
        FeatureMergeParameters,
        "How statements become changes in feature layers.",
    )
    release: ReleaseParameters = setting(ReleaseParameters, "How new versions reach the fleet.")
    ingest: IngestLimits = setting(IngestLimits, "Which reports are refused.")
    feature_layer: tuple[LayerParameters, ...] = setting(
        (),
        "Feature layers that the user declares: reports of other kinds or another geometry are refused there, and"
        " `reach_m` is the layer's own. Undeclared layers take what vehicles report.",
    )
    want: WantParameters = setting(WantParameters, "Which Gaussians of reports in short are asked for.")
    store: StoreConfig = setting(StoreConfig, "Batching of the store.")
    codec: str = setting(
        DEFAULT_CODEC,
        'How finely the Gaussians of tiles are rounded that no base map holds ("float": not at all); all '
        "shards of a store use the same. Other tiles stay as fine as their base.",
    )
    lease_s: float = setting(
        10.0,
        "How long a claim holds that nobody renews: its shard has died or hangs.",
        unit="s",
        above=0,
    )
    poll_s: float = setting(
        0.2,
        "How often to look for tiles and notices when nothing arrives here.",
        unit="s",
        above=0,
    )

    def __post_init__(self) -> None:
        if not _SHARD_ID.fullmatch(self.shard_id):
            raise MergerError(f"shard id {self.shard_id!r} must be 1 to 64 of letters, digits, '.', '_', '-'")
        lattice_named(self.codec)
        check_settings(self, MergerError)
        checked_layers(self.feature_layer)

    def merge_of(self, layer: str) -> FeatureMergeParameters:
        """How statements about a feature layer become changes."""
        return self.features.of_layer(checked_layers(self.feature_layer).get(layer))

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> "ShardConfig":
        """From plain values, as read from TOML; `ConfigError` for an unknown key."""
        return from_mapping(cls, mapping, where="merger")
