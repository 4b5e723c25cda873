"""Values for the tests of messages: one of each kind with known bytes, and strategies for any.

`python tests/schemas/schema_values.py` writes the golden files that are missing. A golden file is never changed: it
stands for the messages that are out there already.
"""

from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from gnd.gnd_map.codec import LATTICES, encode_gaussians, snap
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile, TileDelta
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.archive import UNSIGNED, ArchiveEntry, ArchiveIndex, ArchiveRoot, Pack
from gnd.schemas.catalog_signature import CatalogSignature
from gnd.schemas.changes import ChangeAck, ChangeReport, TileChange
from gnd.schemas.course import Course
from gnd.schemas.district_list import DistrictList, DistrictsHead, DistrictsSignature
from gnd.schemas.doubt import Doubt, DoubtReason
from gnd.schemas.packed import PackedGaussians, PackedReport, digest_of
from gnd.schemas.report_id import deterministic_report_id
from gnd.schemas.report_states import ReportState
from gnd.schemas.tiles import Catalog, CatalogEntry, CodedDelta, TileBlob, TileReply, TileRequest, blob_of
from gnd.schemas.tiles_batch import OtherTiles, TileAnswer, TilesReply, TilesRequest
from gnd.schemas.traffic import TrafficLine, TrafficSample
from gnd.schemas.updates import TileUpdate
from gnd.schemas.version_signature import VersionSignature

GOLDEN_DIR = Path(__file__).parent / "golden"

TILE = TileId(497353963154)
EAST = TileId(497353963155)
SHA = bytes(range(32))
BEFORE_SETS = (4, 3, 2, 7, 6, 5, 1, 0)
"""All codecs of clients that do not read those by sets of tables."""
OTHER_SHA = bytes(range(100, 132))
REPORT_ID = deterministic_report_id(1_700_000_000_000, "car-1", b"drive")


def gaussians(ids: Any, count: int = 40) -> Gaussians:
    """Plausible Gaussians at the voxel ids; count 0 = nothing there."""
    voxel_id = np.unique(np.asarray(ids, np.int32))
    n = len(voxel_id)
    if count == 0:
        return Gaussians.nothing_at(voxel_id)
    mean_m = (np.arange(3 * n, dtype=np.float32).reshape(n, 3) % 7 - 3) / 8
    cov_m2 = np.tile(np.float32([0.0625, 0.015625, 0, 0.0625, 0, 0.0078125]), (n, 1))
    return Gaussians(voxel_id, np.full(n, count, np.int32), np.full(n, count // 2, np.int32), mean_m, cov_m2)


def met(ids: Any, cells: int = 7) -> Gaussians:
    """What a vehicle is unsure of in these voxels."""
    some = gaussians(ids, cells)
    return Gaussians(some.voxel_id, some.count, some.count.copy(), some.mean_m, some.cov_m2)


def mixed(ids: Any) -> Gaussians:
    """Every second voxel holds a Gaussian, the others hold nothing now."""
    voxel_id = np.unique(np.asarray(ids, np.int32))
    full = gaussians(voxel_id)
    there = np.arange(len(voxel_id)) % 2 == 0
    return Gaussians(
        voxel_id,
        np.where(there, full.count, 0).astype(np.int32),
        np.where(there, full.cells, 0).astype(np.int32),
        full.mean_m * there[:, None].astype(np.float32),
        full.cov_m2 * there[:, None].astype(np.float32),
    )


def change(tile: TileId = TILE, **values: Any) -> TileChange:
    changed = values.pop("changed", mixed([-604, -3, 0, 77, 604, 2000]))
    plain: dict[str, Any] = {
        "base_version": 3,
        "base_sha": SHA,
        "observed": np.union1d(np.arange(-700, 900, 3, dtype=np.int32), changed.voxel_id).astype(np.int32),
        "changed": changed,
        "change_class": (np.arange(len(changed)) % 6).astype(np.uint8),
        "evidence": np.arange(4 * len(changed), dtype=np.int32).reshape(-1, 4) * 100,
        "pose_sigma_m": 0.08,
        "pose_sigma_rad": 0.0021,
    }
    return TileChange(tile=tile, **(plain | values))


def report(**values: Any) -> ChangeReport:
    plain: dict[str, Any] = {
        "report_id": REPORT_ID,
        "vehicle": "car-1",
        "sensor_model": "VLP-16",
        "software": "gnd-fleet 0.1.0",
        "district": TILE.district,
        "first_ns": 1_700_000_000_000_000_000,
        "last_ns": 1_700_000_012_300_000_000,
        "tiles": (change(), change(EAST, base_version=0, base_sha=b"")),
    }
    return ChangeReport(**(plain | values))


SHIFTED = Doubt(
    DoubtReason.EXPLAINED_BY_SHIFT | DoubtReason.HEALTH_NOT_GOOD,
    withheld=314,
    explained_permille=873,
    changed_permille=412,
    uncertain_permille=25,
    forward_mm=-31,
    left_mm=204,
    up_mm=-7,
    turn_10urad=-873,
)
MUCH = Doubt(DoubtReason.IMPLAUSIBLE_SHARE, changed_permille=655)
NOTHING = {"changed": Gaussians.empty(), "observed": np.empty(0, np.int32)}


def update(**values: Any) -> TileUpdate:
    plain: dict[str, Any] = {
        "tile": TILE,
        "layer": "ndt",
        "version": 4,
        "previous_version": 3,
        "sha": SHA,
        "previous_sha": OTHER_SHA,
        "reason": "merged",
        "delta": TileDelta(np.array([-600, 12], np.int32), gaussians([-5, 7])),
    }
    return TileUpdate(**(plain | values))


def sample(**values: Any) -> TrafficSample:
    plain: dict[str, Any] = {
        "vehicle": "car-1",
        "t_ns": 1_700_000_000_000_000_000,
        "odometer_m": 123.5,
        "lines": (TrafficLine("tile", "down", 12, 345_678), TrafficLine("change", "up", 2, 5_000)),
        "wire_up_bytes": 6_000,
        "wire_down_bytes": 350_000,
        "lat_rad": 0.6555,
        "lon_rad": 2.2172,
        "health": "good",
        "tiles": 12,
        "reports": 2,
    }
    return TrafficSample(**(plain | values))


# A tile and its next version, on a lattice.
HELD = Tile(TILE, 3, snap(gaussians([-604, 0, 7, 604]), LATTICES["standard"]))
NEXT = Tile(TILE, 4, snap(gaussians([-604, 7, 8], count=300), LATTICES["standard"]))

SIGNED = VersionSignature(b"signer-1", "merged", 1_764_000_000, 1_764_000_000, bytes(range(64)))
SIGNED_LATER = VersionSignature(b"signer-2", "base", 1_763_000_000, 1_764_000_000, bytes(range(64, 128)))
LIST_SIGNATURE = DistrictsSignature(7, 1_764_000_000, b"signer-1", bytes(range(64)))
THREE_DISTRICTS = tuple(TILE.district.first_morton // 1024 + n for n in (0, 1, 300))
DISTRICTS = DistrictList(DistrictsHead.of("ndt", "main", THREE_DISTRICTS), LIST_SIGNATURE, THREE_DISTRICTS)
CATALOG_SIGNATURE = CatalogSignature(7, 1_764_000_000, "rollback", b"signer-1", bytes(range(64)))

GOLDEN: dict[str, Any] = {
    "TileRequest-nothing_cached": TileRequest(codecs=(0,), deltas=False),
    "TileRequest-cached-two_codecs": TileRequest(3, SHA, (1, 0), deltas=False),
    "TileRequest-cached-every_codec-deltas": TileRequest(3, SHA, BEFORE_SETS),
    "TileReply-blob": TileReply("blob", blob_of(Tile(TILE, 7, gaussians([-604, 0, 604])))),
    "TileReply-blob-empty_tile": TileReply("blob", blob_of(Tile(TILE, 1, Gaussians.empty()))),
    "TileReply-unchanged": TileReply("unchanged"),
    "TileReply-absent": TileReply("absent"),
    "TileReply-delta": TileReply("delta", delta=CodedDelta(TILE, 8, SHA, b"not looked into")),
    "TilesRequest-nothing_held": TilesRequest(((0, 0), (274, 0), (1023, 0)), codecs=BEFORE_SETS),
    "TilesRequest-digest": TilesRequest(
        ((274, 3), (275, 0), (276, 2**31 - 1)), SHA[:8], codecs=BEFORE_SETS, max_bytes=60_000, near=274
    ),
    "TilesRequest-hashes": TilesRequest(
        ((274, 3), (275, 0), (276, 1)), held_hashes=(SHA[:8], OTHER_SHA[:8]), codecs=(1, 0)
    ),
    "TilesRequest-others": TilesRequest(
        ((274, 3),), SHA[:8], others=(OtherTiles(-3, ((0, 1), (7, 0)), OTHER_SHA[:8]), OtherTiles(1, ((1023, 0),)))
    ),
    "TilesReply-others": TilesReply(
        (TileAnswer("unchanged"),),
        others=(TilesReply((TileAnswer("absent"), TileAnswer("later")), watched=(1,)), None),
    ),
    "TilesReply-every_status": TilesReply(
        (
            TileAnswer("unchanged"),
            TileAnswer("unchanged"),
            TileAnswer("delta", 4, OTHER_SHA[:4], 0, b"not looked into"),
            TileAnswer("blob", 7, SHA[:4], 0, encode_gaussians(gaussians([-604, 0]))),
            TileAnswer("absent"),
            TileAnswer("hash"),
            TileAnswer("later"),
        )
    ),
    "TilesReply-unchanged": TilesReply((TileAnswer("unchanged"),) * 100),
    "ArchiveIndex-empty": ArchiveIndex("ndt", TILE.district),
    "ArchiveIndex-two_packs": ArchiveIndex(
        "ndt",
        TILE.district,
        (
            ArchiveEntry(TILE, 3, SHA[:4], UNSIGNED, Pack(SHA, 4000), 0, 1200),
            ArchiveEntry(EAST, 2**32 - 1, OTHER_SHA[:4], b"sign", Pack(OTHER_SHA, 900), 100, 800),
        ),
    ),
    "ArchiveIndex-catalog": ArchiveIndex("ndt", TILE.district, catalog=CATALOG_SIGNATURE),
    "ArchiveRoot-empty": ArchiveRoot(),
    "ArchiveRoot-two_layers": ArchiveRoot(
        {"ndt": (TileId(0).district, TILE.district), "signs": (TileId(TILE.morton + 1024).district,)}
    ),
    "Catalog-empty": Catalog(),
    "Catalog-two_tiles": Catalog((CatalogEntry(TILE, 3, SHA), CatalogEntry(EAST, 2**32 - 1, OTHER_SHA))),
    "Catalog-signed": Catalog((CatalogEntry(TILE, 3, SHA),), CATALOG_SIGNATURE),
    "DistrictList-three": DISTRICTS,
    "DistrictList-head": DISTRICTS.without_districts,
    "DistrictList-empty": DistrictList(DistrictsHead.of("lanes", "north-1", ()), LIST_SIGNATURE, ()),
    "ArchiveRoot-lists": ArchiveRoot({"ndt": (TILE.district,)}, lists={"ndt": DISTRICTS}),
    "ChangeReport-two_tiles-with_and_without_base": report(),
    "ChangeReport-nothing_changed": report(tiles=(change(changed=Gaussians.empty()),)),
    "ChangeReport-nothing_observed": report(tiles=(change(changed=Gaussians.empty(), observed=np.empty(0, np.int32)),)),
    "ChangeReport-doubtful": report(tiles=(change(doubt=SHIFTED, **NOTHING), change(EAST, doubt=MUCH))),
    "ChangeReport-course": report(course=Course(-910, 12)),
    "ChangeReport-unsure": report(tiles=(change(), change(EAST, unsure=met([-690, -2, 78])))),
    "ChangeAck-stored": ChangeAck(REPORT_ID, "stored"),
    "ChangeAck-unnamed": ChangeAck(REPORT_ID, "stored").unnamed(),
    "ChangeAck-duplicate": ChangeAck(REPORT_ID, "duplicate"),
    "ChangeAck-quarantined-without_id": ChangeAck("", "quarantined", "TileChange: 3 covariances are not positive"),
    "ChangeAck-wanted": ChangeAck(REPORT_ID, "wanted", wanted=b"not looked into"),
    "ChangeAck-told": ChangeAck(
        REPORT_ID, "stored", told=(ReportState(deterministic_report_id(1_700_000_000_000, "before"), "released"),)
    ),
    "ChangeAck-resend": ChangeAck(REPORT_ID, "resend", "tile 13033/03021/23031/22102 has no version 9 here"),
    "PackedReport-three_tiles": PackedReport(
        report_id=REPORT_ID,
        vehicle="car-1",
        sensor_model="VLP-16",
        software="gnd-fleet 0.1.0",
        first_ns=1_700_000_000_000_000_000,
        length_ns=12_300_000_000,
        tiles=((0, 3), (17, 0), (1023, 2**31 - 1)),
        base_digest=digest_of([SHA, b"", OTHER_SHA]),
        flags=b"not looked into",
        track=b"nor this",
        pose_sigma_tenth_mm=312,
        pose_sigma_10urad=107,
    ),
    "PackedReport-measured": PackedReport(
        report_id=REPORT_ID,
        vehicle="car-1",
        sensor_model="VLP-16",
        software="gnd-fleet 0.1.0",
        first_ns=1_700_000_000_000_000_000,
        length_ns=1,
        tiles=((274, 3),),
        base_digest=SHA[:8],
        flags=b"not looked into",
        track=b"nor this",
        pose_sigma_tenth_mm=812,
        pose_sigma_10urad=87,
        measured=b"Gaussians",
        is_patient=True,
    ),
    "PackedReport-unsure": PackedReport(
        report_id=REPORT_ID,
        vehicle="car-1",
        sensor_model="VLP-16",
        software="gnd-fleet 0.1.0",
        first_ns=1_700_000_000_000_000_000,
        length_ns=1,
        tiles=((274, 3),),
        base_digest=SHA[:8],
        flags=b"not looked into",
        track=b"nor this",
        pose_sigma_tenth_mm=812,
        pose_sigma_10urad=87,
        unsure=b"nor these",
        unsure_measured=b"Gaussians",
    ),
    "PackedReport-doubtful": PackedReport(
        report_id=REPORT_ID,
        vehicle="car-1",
        sensor_model="VLP-16",
        software="gnd-fleet 0.1.0",
        first_ns=1_700_000_000_000_000_000,
        length_ns=12_300_000_000,
        tiles=((0, 3), (17, 0), (1023, 2**31 - 1)),
        base_digest=digest_of([SHA, b"", OTHER_SHA]),
        flags=b"not looked into",
        track=b"nor this",
        pose_sigma_tenth_mm=312,
        pose_sigma_10urad=107,
        doubts=((17, MUCH), (1023, Doubt(DoubtReason.POSE_NOT_CHECKED | DoubtReason.ESTIMATES_DISAGREE))),
    ),
    "PackedReport-course": PackedReport(
        report_id=REPORT_ID,
        vehicle="car-1",
        sensor_model="VLP-16",
        software="gnd-fleet 0.1.0",
        first_ns=1_700_000_000_000_000_000,
        length_ns=12_300_000_000,
        tiles=((0, 3),),
        base_digest=digest_of([SHA]),
        flags=b"not looked into",
        track=b"nor this",
        pose_sigma_tenth_mm=312,
        pose_sigma_10urad=107,
        course=Course(873, 1),
    ),
    "PackedGaussians-some": PackedGaussians(REPORT_ID, b"not looked into", 0xDEADBEEF),
    "TileUpdate-merged-delta": update(),
    "TileUpdate-merged-coded_delta": update(delta=None, coded_delta=b"not looked into", put_voxels=2, removed_voxels=2),
    "TileUpdate-base-new_tile": update(version=1, previous_version=0, previous_sha=b"", reason="base", delta=None),
    "TileUpdate-rollback": update(reason="rollback", delta=None),
    "TileUpdate-day": update(day=9750),
    "TileReply-blob-day": TileReply("blob", blob_of(Tile(TILE, 7, gaussians([-604, 0, 604]), 9750))),
    "TileReply-delta-day": TileReply("delta", delta=CodedDelta(TILE, 8, SHA, b"not looked into", 9750)),
    "TilesReply-one_day": TilesReply((TileAnswer("delta", 4, OTHER_SHA[:4], 0, b"not looked into", 9750),) * 3),
    "TilesReply-days": TilesReply(
        (
            TileAnswer("delta", 4, OTHER_SHA[:4], 0, b"not looked into", 9750),
            TileAnswer("absent"),
            TileAnswer("delta", 5, SHA[:4], 0, b"not looked into"),
        )
    ),
    "TileReply-blob-signed": TileReply(
        "blob", blob_of(Tile(TILE, 7, gaussians([-604, 0, 604]), 9750)), signature=SIGNED
    ),
    "TilesReply-signed": TilesReply((TileAnswer("delta", 4, OTHER_SHA[:4], 0, b"not looked into", 9750, SIGNED),) * 2),
    "TilesReply-some_signed": TilesReply(
        (
            TileAnswer("delta", 4, OTHER_SHA[:4], 0, b"not looked into", 9750, SIGNED),
            TileAnswer("absent"),
            TileAnswer("delta", 5, SHA[:4], 0, b"not looked into"),
            TileAnswer("blob", 5, SHA[:4], 4, b"not looked into", 0, SIGNED_LATER),
        )
    ),
    "TileUpdate-made": update(day=9750, made_s=1_764_000_000),
    "TrafficSample-two_lines": sample(),
    "TrafficSample-stale_map": sample(map_stale_h=26),
    "TrafficSample-doubts": sample(scans_taken_back=31, tiles_held_back=2, tiles_doubtful=4, doubts=(2, 0, 1, 0, 1)),
    "TrafficSample-start": sample(
        lines=(), odometer_m=0.0, wire_up_bytes=0, wire_down_bytes=0, health="starting", tiles=0, reports=0
    ),
}

KINDS: dict[str, Any] = {
    kind.__name__: kind
    for kind in (
        TileRequest,
        TileReply,
        TileBlob,
        TilesRequest,
        TilesReply,
        ArchiveIndex,
        ArchiveRoot,
        Catalog,
        DistrictList,
        ChangeReport,
        ChangeAck,
        PackedReport,
        PackedGaussians,
        TileUpdate,
        TrafficSample,
    )
}


def kind_of(name: str) -> Any:
    """The class that a golden file's name begins with."""
    return KINDS[name.split("-")[0]]


# Strategies

shas = st.binary(min_size=32, max_size=32)
versions = st.integers(1, 2**32 - 1)
voxel_sets = st.frozensets(st.integers(-5000, 60_000), max_size=12).map(sorted)
tiles = st.integers(0, 2**39 - 1).map(TileId)
district_tiles = st.frozensets(st.integers(0, 1023), min_size=1, max_size=3).map(
    lambda offsets: [TileId(TILE.district.first_morton + k) for k in sorted(offsets)]
)
pairs = st.one_of(st.just((0, b"")), st.tuples(versions, shas))
names = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9._-]{0,20}", fullmatch=True)
texts = st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs")), max_size=60)


@st.composite
def any_gaussians(draw: Any, ids: Any = None, *, with_nothing: bool = False) -> Gaussians:
    """Gaussians with positive covariances inside their voxels; some hold nothing when asked for."""
    voxel_id = np.array(draw(voxel_sets) if ids is None else ids, np.int32)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n = len(voxel_id)
    spread = rng.uniform(-0.3, 0.3, (n, 3, 3))
    cov = (spread @ np.swapaxes(spread, 1, 2))[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    there = rng.random(n) < (0.6 if with_nothing else 1.1)
    columns = (rng.integers(1, 2**31, n), rng.integers(1, 1001, n), rng.uniform(-0.5, 0.5, (n, 3)), cov)
    kept = [np.where(there.reshape(-1, *[1] * (c.ndim - 1)), c, 0) for c in columns]
    kinds = (np.int32, np.int32, np.float32, np.float32)
    return Gaussians(voxel_id, *(c.astype(kind) for c, kind in zip(kept, kinds, strict=True)))


@st.composite
def any_doubt(draw: Any, *, withholds: bool = False) -> Doubt:
    """With every reason, those of newer versions too."""
    permille, mm = st.integers(0, 1000), st.integers(-100_000, 100_000)
    return Doubt(
        DoubtReason(draw(st.integers(1, 2**32 - 1))),
        draw(st.integers(1, 2**32 - 1)) if withholds else 0,
        *(draw(permille) for _ in range(3)),
        *(draw(mm) for _ in range(3)),
        draw(st.integers(-314_160, 314_160)),
    )


@st.composite
def any_change(draw: Any, tile: TileId) -> TileChange:
    changed, seen = draw(any_gaussians(with_nothing=True)), draw(voxel_sets)
    withholds = draw(st.sampled_from([False, False, True]))
    if withholds:
        changed, seen = Gaussians.empty(), []
    observed = np.union1d(changed.voxel_id, seen).astype(np.int32)
    n, free = len(changed), np.setdiff1d(np.array(draw(voxel_sets), np.int32), observed).astype(np.int32)
    unsure = Gaussians.empty() if withholds else met(free, draw(st.integers(1, 19)))
    version, sha = draw(pairs)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    return TileChange(
        tile=tile,
        base_version=version,
        base_sha=sha,
        observed=observed,
        changed=changed,
        change_class=rng.integers(0, 6, n).astype(np.uint8),
        evidence=rng.integers(0, 2**31, (n, 4)).astype(np.int32),
        pose_sigma_m=draw(st.floats(0, 1000)),
        pose_sigma_rad=draw(st.floats(0, 3.15)),
        doubt=draw(any_doubt(withholds=True) if withholds else st.none() | any_doubt()),
        unsure=unsure,
    )


@st.composite
def any_report(draw: Any) -> ChangeReport:
    first, last = sorted(draw(st.tuples(st.integers(0, 2**63 - 1), st.integers(0, 2**63 - 1))))
    return ChangeReport(
        report_id=deterministic_report_id(draw(st.integers(0, 2**48 - 1)), draw(texts)),
        vehicle=draw(names),
        sensor_model=draw(texts),
        software=draw(texts),
        district=TILE.district,
        first_ns=first,
        last_ns=last,
        tiles=tuple(draw(any_change(tile)) for tile in draw(district_tiles)),
        layer=draw(st.from_regex(r"[a-z][a-z0-9_]{0,31}", fullmatch=True)),
    )


@st.composite
def any_update(draw: Any) -> TileUpdate:
    previous, previous_sha = draw(st.one_of(st.just((0, b"")), st.tuples(st.integers(1, 2**32 - 2), shas)))
    put = draw(any_gaussians())
    removed = np.setdiff1d(np.array(draw(voxel_sets), np.int32), put.voxel_id).astype(np.int32)
    return TileUpdate(
        tile=draw(tiles),
        layer="ndt",
        version=draw(st.integers(previous + 1, 2**32 - 1)),
        previous_version=previous,
        sha=draw(shas),
        previous_sha=previous_sha,
        reason=draw(st.sampled_from(["merged", "base", "rollback"])),
        delta=draw(st.one_of(st.none(), st.just(TileDelta(removed, put)))),
    )


@st.composite
def any_tile(draw: Any) -> Tile:
    return Tile(draw(tiles), draw(versions), draw(any_gaussians()))


def write_missing_golden_files() -> None:
    GOLDEN_DIR.mkdir(exist_ok=True)
    for name, value in GOLDEN.items():
        path = GOLDEN_DIR / f"{name}.bin"
        if not path.exists():
            path.write_bytes(value.encode())


if __name__ == "__main__":
    write_missing_golden_files()
