"""What is copied of a store: its tables by the order in which rows may be written, and the columns that tell a row."""

from dataclasses import dataclass
from typing import Any, Final

Row = tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class Contents:
    """A table. `key`: the columns of its primary key; `hashes`: those of them that hold bytes."""

    table: str
    key: tuple[str, ...]
    hashes: tuple[str, ...] = ()


_TILE: Final = ("layer", "tile")
_VERSION: Final = (*_TILE, "version")
_REPORT: Final = (*_TILE, "report_id")

ALL: Final = (
    Contents("tile_version", _VERSION),
    Contents("tile_head", _TILE),
    Contents("notice", _VERSION),
    Contents("report", ("arrival",)),
    Contents("journal", _TILE),
    Contents("dirty", _TILE),
    Contents("upload", ("upload",)),
    Contents("survey", _VERSION),
    Contents("merge_parameters", ("number",)),
    Contents("tile_memory", _TILE),
    Contents("version_basis", _VERSION),
    Contents("closed_window", (*_TILE, "window")),
    Contents("waiting_change", (*_TILE, "vehicle", "reason")),
    Contents("shift_test", _REPORT),
    Contents("course_said", _REPORT),
    Contents("agreement_test", _REPORT),
    Contents("shifted_vehicle", ("vehicle",)),
    Contents("quarantined_vehicle", ("vehicle",)),
    Contents("pardon", ("vehicle",)),
    Contents("vehicle_owner", ("vehicle", "since_ns")),
    Contents("standing", (*_TILE, "window", "vehicle")),
    Contents("alone_day", ("vehicle", "day")),
    Contents("lone_word", ("vehicle", "day")),
    Contents("coincidence", (*_TILE, "one", "other")),
    Contents("vehicle_group", ("one", "other")),
    Contents("vehicle_place", ("vehicle", "report_id")),
    Contents("impossible_place", ("vehicle",)),
    Contents("trial", _VERSION),
    Contents("trial_salt", ("one",)),
    Contents("trial_health", (*_VERSION, "vehicle")),
    Contents("doubted_report", (*_VERSION, "report_id")),
    Contents("trial_steered", ("number",)),
    Contents("road_part", ("arrival",)),
    Contents("road_tile", _TILE),
    Contents("road_work", ("layer",)),
    Contents("feature_source", ("name",)),
    Contents("publisher", ("signer",), ("signer",)),
    Contents("body_place", ("number",)),
    Contents("body_going", ("sha", "codec_id"), ("sha",)),
    Contents("quarantine", ("sha",), ("sha",)),
    Contents("quarantine_size", ("one",)),  # after what triggers count in it
)
"""In this order; rows are removed in the opposite one."""
OF_THE_PLACE: Final = ("queue_boot", "shard", "store_schema")
"""Which clock leases run by, which shards have shown life, and the schema's number: those of the target are its own."""
FENCED: Final = (*(one.table for one in ALL), "queue_boot", "shard")
"""Tables to which a store that has moved takes no writes, also none of those that say that somebody is there."""
MADE_WITH_THE_STORE: Final = ("trial_salt", "quarantine_size")
"""Tables of an empty store that hold a row."""
