"""The message of each kind that costs most CPU, found by a search that changes sizes and keeps what costs more.

Uploads go the way of a shard: into a store and through the expander, commit included; questions through what answers
them. Each is within what the messages themselves allow; a message that is refused counts with what it cost until then.
"""

import contextlib
import itertools
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.expander import Expander
from gnd.cloud_merger.features.kept import square
from gnd.cloud_merger.served import ServedCpu
from gnd.cloud_merger.states import answer
from gnd.deploy.chaos.street import ChaosStreet, read_street
from gnd.fleet_bus.errors import Refused
from gnd.gnd_map.arrays import I32
from gnd.gnd_map.codec import Flags, encode_flags
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.features.existence import Existence
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile_id import TileId
from gnd.gnd_map.track import Track, TrackPiece, encode_track
from gnd.schemas.changes import TileChange
from gnd.schemas.features import FeatureChange, FeatureReport, Found
from gnd.schemas.keys import change_key, state_key
from gnd.schemas.packed import digest_of
from gnd.schemas.report_id import deterministic_report_id
from gnd.schemas.report_states import ReportQuestion
from gnd.schemas.tiles_batch import TilesRequest
from gnd.schemas.upload_head import head_of_upload
from gnd.tile_store.answers import TileAnswers
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.uploads import Upload
from studies.frame.measure import Figure
from studies.frame.options import check, option
from studies.small_cloud import base_tile, change_report

Sizes = dict[str, int]
KINDS: Final = ("packed", "whole", "features", "tiles", "states")
_T0_MS: Final = 1_700_000_000_000
_NUMBERS = itertools.count()
_VEHICLE: Final = "dear"


@dataclass(frozen=True, slots=True)
class DearestOptions:
    """How long is searched."""

    seconds: float = option(40.0, "CPU seconds for each kind, s.", span=(0.1, 36_000))
    seed: int = option(1, "Of the search.", span=(0, None))
    kinds: tuple[str, ...] = option(KINDS, "Kinds of messages.", known=KINDS)

    def __post_init__(self) -> None:
        check(self)


OPTIONS: Final = DearestOptions


@dataclass(frozen=True, slots=True)
class _Kind:
    """What is searched: the largest sizes, a message of sizes, and what a cloud does with it."""

    most: Mapping[str, int]
    made: Callable[[Sizes], tuple[str, bytes]]
    taken: Callable[[str, bytes], object]


def run(options: DearestOptions | None = None) -> list[Figure]:
    """Search each kind."""
    options = options or DearestOptions()
    street = read_street()
    with tempfile.TemporaryDirectory() as folder, SqliteStore(Path(folder) / "store.sqlite") as store:
        store.put_tiles([*street.tiles, base_tile()])
        return [_dearest(name, _kinds(street, store)[name], options) for name in options.kinds]


def _kinds(street: ChaosStreet, store: SqliteStore) -> dict[str, _Kind]:
    expander = Expander(store, ShardConfig("dearest", store.path), lambda _vehicle, _state: None)
    answers = TileAnswers(store)
    district = street.copies[0][0].tile_id.district

    def expanded(key: str, body: bytes) -> None:
        head = head_of_upload(body)
        store.put_upload(Upload(key, body, head.report_id, head.vehicle, head.form, 1), "dearest")
        expander.served = ServedCpu()  # nothing waits for its share here
        while expander.work():
            pass

    def tiles(_key: str, body: bytes) -> object:
        return answers.many("ndt", district, TilesRequest.decode(body)).encode()

    return {
        "packed": _Kind(_PACKED, lambda sizes: _packed(street, sizes), expanded),
        "whole": _Kind(_WHOLE, whole_report, expanded),
        "features": _Kind({"tiles": 1024, "found": 4096, "points": 4096, "attributes": 16}, _features, expanded),
        "tiles": _Kind({"tiles": 1024, "version": 1 << 30}, _tiles_question, tiles),
        "states": _Kind({"ids": 64}, _states_question, lambda key, body: answer(store, key, body)),
    }


def _dearest(name: str, kind: _Kind, options: DearestOptions) -> Figure:
    """Hill climbing from random sizes, begun anew now and then."""
    rng, tried, refused = Random(f"{options.seed} {name}"), 0, 0
    best: tuple[float, int, Sizes] = (0.0, 1, dict.fromkeys(kind.most, 1))
    until_s = time.process_time() + options.seconds
    while time.process_time() < until_s:
        sizes = _other(best[2], kind.most, rng)
        try:
            cost_s, size = _cost(kind, sizes)
            if cost_s > best[0]:  # once more: the first may have warmed something up
                cost_s = min(cost_s, _cost(kind, sizes)[0])
        except (GndError, ValueError, OverflowError):  # no such message
            refused += 1
            continue
        tried += 1
        if cost_s > best[0]:
            best = cost_s, size, sizes
    cost_s, size, sizes = best
    detail = (
        f"{size / 1000:.1f} kB, {1e3 * cost_s / max(size / 1000, 0.1):.2f} ms/kB; "
        f"{', '.join(f'{one} {n}' for one, n in sizes.items())}; {tried} tried, {refused} of no such message"
    )
    return Figure(f"most CPU of a message, {name}", 1e3 * cost_s, "ms", detail)


def _cost(kind: _Kind, sizes: Sizes) -> tuple[float, int]:
    """CPU seconds of a message of these sizes, refused or not, and its bytes; a GndError: there is none."""
    key, body = kind.made(sizes)
    began_s = time.process_time()
    with contextlib.suppress(GndError, Refused):
        kind.taken(key, body)
    return time.process_time() - began_s, len(body)


def _other(sizes: Sizes, most: Mapping[str, int], rng: Random) -> Sizes:
    if rng.random() < 0.2:
        return {name: round(rng.uniform(1.0, limit) ** rng.random()) for name, limit in most.items()}
    changed = dict(sizes)
    for name in rng.sample(sorted(most), rng.randint(1, min(2, len(most)))):
        changed[name] = min(most[name], max(1, round(changed[name] * 2.0 ** rng.uniform(-2.0, 2.0))))
    return changed


_PACKED: Final = {"tiles": 200, "flags": 20_000, "top": 450, "pieces": 160, "points": 64, "step": 400}


def _packed(street: ChaosStreet, sizes: Sizes) -> tuple[str, bytes]:
    """Flags strewn over tiles near the map and floors, and a way of pieces."""
    district = street.copies[0][0].tile_id.district
    near = {one for tile in street.copies[0] for one in square(tile.tile_id, 3) if one.district == district}
    free = sorted(near - {tile.tile_id for tile in (*street.tiles, base_tile())})[: sizes["tiles"]]
    rng, told = np.random.default_rng(sizes["flags"]), []
    for tile_id in free:
        ids = _strewn(tile_id, max(1, sizes["flags"] // len(free)), sizes["top"], rng)
        told.append(Flags(tile_id, Gaussians.empty(), ids, np.ones(len(ids), np.uint8)))
    steps = np.arange(sizes["points"])[:, None] * np.array([[sizes["step"], 1, 0]])
    way = tuple(
        TrackPiece((steps + np.array([[4 * k, 64 * k, 0]])).astype(np.int32), 1000) for k in range(sizes["pieces"])
    )
    packed = replace(
        street.said(1, _VEHICLE, 0).packed,
        report_id=_new_id(),
        vehicle=_VEHICLE,
        tiles=tuple((tile_id.morton - district.first_morton, 0) for tile_id in free),
        base_digest=digest_of([b""] * len(free)),
        flags=encode_flags(told),
        track=encode_track(Track(district, street.told[0].track.view, way)),
        doubts=(),
    )
    return change_key("ndt", district), packed.encode()


_WHOLE: Final = {"tiles": 64, "changed": 40_000, "observed": 200_000, "top": 400, "held": 1}


def whole_report(sizes: Sizes) -> tuple[str, bytes]:
    """Gaussians strewn over tiles and floors."""
    base, rng = base_tile(), np.random.default_rng(sizes["changed"])
    (like,) = change_report(1, base).tiles
    tiles = []
    for index in range(sizes["tiles"]):
        tile_id = TileId(base.tile_id.morton + index)
        ids = _strewn(tile_id, max(1, sizes["changed"] // sizes["tiles"]), sizes["top"], rng)
        seen = _strewn(tile_id, max(1, sizes["observed"] // sizes["tiles"]), sizes["top"], rng)
        is_base = index == 0
        tiles.append(_change(like, tile_id, ids, np.union1d(ids, seen).astype(np.int32), is_base=is_base))
    report = replace(change_report(1, base), report_id=_new_id(), vehicle=_VEHICLE, tiles=tuple(tiles))
    return change_key("ndt", report.district), report.encode()


def _change(like: TileChange, tile_id: TileId, ids: I32, observed: I32, *, is_base: bool) -> TileChange:
    n, one = len(ids), like.changed
    gaussians = Gaussians(
        ids, np.full(n, 200, np.int32), np.full(n, 60, np.int32), np.zeros((n, 3), np.float32), _first(one.cov_m2, n)
    )
    return replace(
        like,
        tile=tile_id,
        base_version=like.base_version if is_base else 0,
        base_sha=like.base_sha if is_base else b"",
        observed=observed,
        changed=gaussians,
        change_class=np.full(n, 2 if is_base else 1, np.uint8),
        evidence=np.full((n, 4), 9, np.int32),
    )


def _first(rows: NDArray[np.float32], n: int) -> NDArray[np.float32]:
    return np.repeat(rows[:1], n, axis=0)


def _strewn(tile_id: TileId, n: int, top: int, rng: np.random.Generator) -> I32:
    """So many voxels of a tile, up to a height of floors, ascending."""
    grid = VoxelGrid.of(tile_id)
    at = [rng.integers(0, size, n) for size in (grid.nx, grid.ny, max(1, top))]
    return np.unique(grid.voxel_id(*at)).astype(np.int32)


def _features(sizes: Sizes) -> tuple[str, bytes]:
    """Lines of many points in many tiles."""
    base = base_tile()
    points = np.cumsum(np.full((sizes["points"], 3), 0.002), axis=0)
    cov = np.array([0.01, 0.0, 0.0, 0.01, 0.0, 0.01])
    attributes = tuple((f"name{n}", "x" * 60) for n in range(sizes["attributes"] - 1))
    one = Found("lane_boundary", points, cov, Existence(0.9, 0.0, 0.1), 4, attributes)
    each = max(1, sizes["found"] // sizes["tiles"])
    tiles = tuple(
        FeatureChange(TileId(base.tile_id.district.first_morton + n), 0, b"", 2**64 - 1, (), (one,) * each)
        for n in range(sizes["tiles"])
    )
    report = FeatureReport(_new_id(), _VEHICLE, "camera", "study", "lanes", base.tile_id.district, 1, 2, tiles)
    return change_key("lanes", report.district), report.encode()


def _tiles_question(sizes: Sizes) -> tuple[str, bytes]:
    request = TilesRequest(wanted=tuple((n, sizes["version"] - 1) for n in range(sizes["tiles"])))
    return "", request.encode()


def _states_question(sizes: Sizes) -> tuple[str, bytes]:
    ids = tuple(deterministic_report_id(_T0_MS + n, "question") for n in range(sizes["ids"]))
    return state_key(_VEHICLE), ReportQuestion(ids).encode()


def _new_id() -> str:
    number = next(_NUMBERS)
    return deterministic_report_id(_T0_MS + number, "dearest", str(number))
