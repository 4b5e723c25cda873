"""A shard has its kernels ready: warming compiles what reports in short need, once, and starts nothing."""

import threading

import numpy as np
from merger_world import POLE, TILE, WALL_AGAIN
from short_world import bases_of, drive_number, packed_of, tile_at
from street_corner import displaced, mapped, seen_as, street

from gnd.cloud_merger import confirmation, decide_kernels, merge_kernels, shift_kernels, statements, votes
from gnd.cloud_merger.decide_kernels import decided
from gnd.cloud_merger.expanding import expand, with_measured
from gnd.cloud_merger.merge_kernels import clusters_of
from gnd.cloud_merger.parameters import MergeParameters
from gnd.cloud_merger.shift import shift_of
from gnd.cloud_merger.statements import STATEMENT, Report, statements_of
from gnd.cloud_merger.votes import TileVotes
from gnd.cloud_merger.warm import warm_up
from gnd.gnd_map import sight, similarity
from gnd.gnd_map.codec import encode_mask, kernels, lattice_kernels
from gnd.schemas.packed import PackedReport
from gnd.vehicle_agent.report.packing import askable, pack_measured

CORNER = mapped(street(0))


KERNELS = (
    sight,
    kernels,
    lattice_kernels,
    similarity,
    confirmation,
    decide_kernels,
    merge_kernels,
    shift_kernels,
    statements,
    votes,
)


def signatures():
    return {
        f"{module.__name__}.{name}": len(value.signatures)
        for module in KERNELS
        for name, value in vars(module).items()
        if hasattr(value, "signatures")
    }


def test_warming_leaves_nothing_to_compile_for_the_first_report():
    threads = threading.active_count()
    warm_up()
    warm = signatures()
    assert warm["gnd.cloud_merger.shift_kernels.votes_up"] == warm["gnd.cloud_merger.merge_kernels.label_voxels"] == 1
    assert warm["gnd.gnd_map.sight.cast_fans"] == 1
    report = drive_number(1, new={3: POLE}, modified={1: WALL_AGAIN}, deleted=(2,))
    packed = PackedReport.decode(packed_of(report))
    expanded = expand(packed, "ndt", TILE.district, [tile_at()])
    mask = np.ones(askable(report), np.bool_)
    half = pack_measured(report, bases_of(report), encode_mask(mask))
    found = with_measured(expanded, {TILE: tile_at().gaussians}, mask, half.measured).tiles[0].changed
    yes = found.exists
    similarity.similarity(yes, found.mean_m, found.cov_m2, yes, found.mean_m, found.cov_m2)
    told = [Report("a", expanded.tiles[0]), Report("b", expanded.tiles[0])]
    TileVotes.of(told).about(found.voxel_id, expanded.tiles[0].base_sha, bases_of(report))
    statements_of(tile_at().gaussians, told, bases_of(report))
    clusters_of(np.zeros(5, STATEMENT), MergeParameters())
    decided(np.zeros(5, STATEMENT), found, MergeParameters())
    assert shift_of(seen_as(CORNER, displaced(street(1), 0.2, 0.3)), CORNER).is_explained
    assert signatures() == warm
    assert threading.active_count() == threads
