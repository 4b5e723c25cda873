"""What is copied of a store: its tables by the order in which rows may be written, and the columns that tell a row."""

from dataclasses import dataclass
from typing import Any, Final, Literal

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
    Contents("catalog_state", _TILE),
    Contents("district_list", ("layer",)),
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
    Contents("district_owner", ("district",)),
    Contents("border_row", (*_REPORT, "part")),
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


@dataclass(frozen=True, slots=True)
class DistrictPart:
    """A table of which the rows of a district move to another store.

    Attributes:
        contents: with a key that means the same in both stores.
        kind: "early": rows come while the district is still the other's; "late": with the switch, for somebody acts
            upon them or they make the district visible; "upload": those that wait come late, the others early.
        numbered: the column in which each store numbers rows by itself; "": none.
        guarded: columns whose changes are refused where the district is not written to; (): of all. Leases are not.
        keeps: whether rows may not be removed while the district leaves.
    """

    contents: Contents
    kind: Literal["early", "late", "upload"] = "early"
    numbered: str = ""
    guarded: tuple[str, ...] = ()
    keeps: bool = True

    @property
    def table(self) -> str:
        """Its name."""
        return self.contents.table


_KEYS: Final = {one.table: one for one in ALL}
OF_DISTRICT: Final = (
    DistrictPart(_KEYS["tile_version"]),
    DistrictPart(Contents("report", (*_REPORT, "part")), numbered="arrival"),
    *(
        DistrictPart(_KEYS[table])
        for table in (
            "tile_memory", "version_basis", "closed_window", "waiting_change", "shift_test", "course_said",
            "agreement_test", "standing", "coincidence", "trial", "trial_health", "doubted_report", "road_tile",
        )
    ),
    DistrictPart(
        Contents("upload", ("sha",), ("sha",)),
        "upload",
        "upload",
        ("state", "body", "wanted", "journal_id", "report_id"),
    ),
    DistrictPart(_KEYS["tile_head"], "late"),
    DistrictPart(_KEYS["catalog_state"], "late"),
    DistrictPart(_KEYS["survey"], "late"),
    DistrictPart(_KEYS["journal"], "late"),
    DistrictPart(_KEYS["dirty"], "late", guarded=("seq", "waiting")),
    DistrictPart(_KEYS["notice"], "late", keeps=False),
)  # fmt: skip
"""In the order in which rows may be written."""
STAYS: Final = (
    "merge_parameters", "publisher", "shifted_vehicle", "quarantined_vehicle", "pardon", "vehicle_owner", "alone_day",
    "lone_word", "vehicle_group", "vehicle_place", "impossible_place", "trial_salt", "trial_steered", "road_part",
    "road_work", "feature_source", "district_owner", "district_list", "border_row", "body_place",
    "body_going", "quarantine", "quarantine_size",
)  # fmt: skip
"""Tables of the whole store; `copying.district` says what a move tells the other store of them."""
