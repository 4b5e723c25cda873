"""What a store keeps of the files that its features come from: how they were read, which features they gave, and the
file itself, so that what was no feature can be given back on export.

It lies in the store beside the tiles, in a table of its own, and is written in the same transaction as they are. It
never goes to vehicles.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import zstandard

from gnd.gnd_map.bounded import json_value, zstd_unpacked
from gnd.tile_store.connection import SqlConnection, change, fetch
from gnd.tile_store.errors import StoreError
from gnd.tile_store.feature_io.errors import FeatureFileError
from gnd.tile_store.feature_io.lane_network import MapLane, lane_of

MAX_DOCUMENT_BYTES: Final = 1_000_000_000
_LEVEL: Final = 9


@dataclass(frozen=True, slots=True)
class FeatureSource:
    """One file that was imported.

    name: what its features are known by. format: "lanelet2", "geojson", ... ids: of its features by layer.
    options: how it was read. document: its bytes, b"" when the format has no remainder to keep. lanes: its lanes.
    """

    name: str
    format: str
    ids: Mapping[str, tuple[int, ...]]
    options: Mapping[str, Any]
    document: bytes = field(default=b"", repr=False)
    lanes: tuple[MapLane, ...] = field(default=(), repr=False)

    def __post_init__(self) -> None:
        if not 1 <= len(self.name) <= 200:
            raise FeatureFileError(f"a source's name has 1 … 200 characters, got {len(self.name)}")


def put_source(c: SqlConnection, source: FeatureSource, now_ns: int) -> None:
    """Keep a source in place of one of the same name; inside the caller's transaction."""
    ids = {layer: list(numbers) for layer, numbers in source.ids.items()}
    lanes = [lane.as_list() for lane in source.lanes]
    about = {"format": source.format, "options": dict(source.options), "ids": ids, "lanes": lanes}
    change(c, "make_feature_source", {})
    body = zstandard.compress(source.document, _LEVEL)
    row = {"name": source.name, "created_ns": now_ns, "about": json.dumps(about), "body": body}
    change(c, "put_feature_source", row)


def get_sources(c: SqlConnection) -> list[FeatureSource]:
    """All sources, sorted by name."""
    if not fetch(c, "feature_source_exists"):
        return []
    return [_source(*row) for row in fetch(c, "feature_sources")]


def _source(name: str, about: str, body: bytes) -> FeatureSource:
    try:
        told = json_value(about)
        document = zstd_unpacked(body, MAX_DOCUMENT_BYTES)
        ids = {layer: tuple(map(int, numbers)) for layer, numbers in told["ids"].items()}
        lanes = tuple(map(lane_of, told.get("lanes", ())))
        return FeatureSource(name, told["format"], ids, told["options"], document, lanes)
    except (FeatureFileError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise StoreError(f"source {name!r:.80} of the store is damaged: {type(error).__name__}: {error}") from None
