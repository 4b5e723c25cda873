"""Compile or load the kernels of a shard before the first tile or report waits for them."""

import numpy as np

from gnd.cloud_merger.confirmation import changes_together
from gnd.cloud_merger.decide_kernels import decided
from gnd.cloud_merger.merge_kernels import clusters_of
from gnd.cloud_merger.parameters import MergeParameters
from gnd.cloud_merger.shift import SHIFT_LEAST_GAUSSIANS, shift_of
from gnd.cloud_merger.statements import STATEMENT, Report, statements_of
from gnd.cloud_merger.votes import TileVotes
from gnd.gnd_map.arrays import I32
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.codec import (
    REPORT,
    Flags,
    decode_flags,
    decode_mask,
    decode_measured,
    encode_flags,
    encode_mask,
    encode_measured,
    snap,
)
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.similarity import similarity
from gnd.gnd_map.tile_id import TileId
from gnd.gnd_map.track import STEPS, Track, TrackPiece, TrackView
from gnd.gnd_map.vehicle_shape import warm_up as warm_up_shapes
from gnd.gnd_map.visibility import observed_along
from gnd.schemas.changes import TileChange
from gnd.tile_store.warm import warm_up as warm_up_codecs

_TILE = TileId(497353963154)


def warm_up() -> None:
    """Write and read a tiny tile and a tiny report in short; starts no thread and opens nothing."""
    warm_up_codecs()
    base = _base()
    flags = [Flags(_TILE, base, base.voxel_id[:1], np.array([ChangeClass.MODIFIED], np.uint8))]
    (found,) = decode_flags([(_TILE, base)], encode_flags(flags))
    measured = encode_measured([(_TILE, base, base.take([0]))])
    decode_measured([(_TILE, base, found.voxel_id)], measured)
    decode_mask(encode_mask(np.array([True])), 1)
    observed_along(Track(_TILE.district, TrackView((-8, -6, -4, -2, 0, 2, 4, 6, 8)), (_place(),)), [found])
    similarity(base.exists, base.mean_m, base.cov_m2, base.exists, base.mean_m, base.cov_m2)
    said = Report("warm-up", _changed(base.voxel_id, base))
    TileVotes.of([said]).about(base.voxel_id, b"", {})
    statements_of(base, [said], {})
    clusters_of(np.zeros(1, STATEMENT), MergeParameters())
    decided(np.zeros(1, STATEMENT), base, MergeParameters())
    place = np.zeros(1, np.int64)
    changes_together(place, place, place, np.ones(1, np.bool_))
    warm_up_shapes()  # those of the season, too
    _test_a_shift()


def _test_a_shift() -> None:
    """Level ground that is measured higher than it was: every kernel of the shift test has something to say."""
    ids = np.arange(SHIFT_LEAST_GAUSSIANS, dtype=np.int32)
    n = len(ids)
    count, cov = np.full(n, 40, np.int32), np.tile(np.array([0.08, 0.0, 0.0, 0.08, 0.0, 0.0004], np.float32), (n, 1))
    low, high = (Gaussians(ids, count, count, np.full((n, 3), up_m, np.float32), cov) for up_m in (0.0, 0.4))
    shift_of(_changed(ids, high), low)


def _changed(observed: I32, found: Gaussians) -> TileChange:
    """What one without a map says of what it has found."""
    n = len(found)
    evidence, classes = np.zeros((n, 4), np.int32), np.full(n, ChangeClass.MODIFIED, np.uint8)
    return TileChange(_TILE, 0, b"", observed, found, classes, evidence, 0.0, 0.0)


def _place() -> TrackPiece:
    """In the middle of the tile, 2 m up."""
    corner = TileId(_TILE.district.first_morton)
    east, north = _TILE.lon_index - corner.lon_index, _TILE.lat_index - corner.lat_index
    return TrackPiece(np.array([[STEPS * east + STEPS // 2, STEPS * north + STEPS // 2, 4]], np.int32), 1)


def _base() -> Gaussians:
    """Two voxels of ground on the lattice on which reports travel."""
    cov = np.tile(np.array([0.08, 0.0, 0.0, 0.08, 0.0, 0.0004], np.float32), (2, 1))
    ids, count = np.array([0, 1], np.int32), np.array([40, 40], np.int32)
    return snap(Gaussians(ids, count, count // 2, np.zeros((2, 3), np.float32), cov), REPORT)
