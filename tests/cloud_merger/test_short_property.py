"""Packing and expanding undo each other, whatever is flagged against whatever base."""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from merger_world import NEIGHBOUR, TILE, change_of, report_of
from short_world import track_by

from gnd.cloud_merger.expanding import expand, with_measured
from gnd.cloud_merger.wants import asked_voxels
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.codec import LATTICES, REPORT, decode_mask, encode_mask, snap
from gnd.gnd_map.gaussian import Gaussians, concat
from gnd.gnd_map.tile import Tile
from gnd.schemas.packed import PackedGaussians, PackedReport, crc_of
from gnd.vehicle_agent.report.packing import askable, pack, pack_measured

VOXELS = np.arange(-700, 2400, 7)


def gaussians(rng, ids, lattice):
    """Any Gaussians that points inside their voxels may have."""
    n = len(ids)
    spread = rng.uniform(-0.25, 0.25, (n, 3, 3)) * rng.uniform(0.05, 1.0, (n, 1, 3))
    cov = (spread @ np.swapaxes(spread, 1, 2))[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]] + 1e-5 * np.eye(3)[
        [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]
    ]
    count = rng.integers(20, 5000, n).astype(np.int32)
    mean = rng.uniform(-0.45, 0.45, (n, 3)).astype(np.float32)
    return snap(Gaussians(ids.astype(np.int32), count, np.minimum(count, 20), mean, cov.astype(np.float32)), lattice)


def change(rng, tile):
    """Any flags against any base, or against none."""
    held = np.sort(rng.choice(VOXELS, rng.integers(0, 60), replace=False))
    base = gaussians(rng, held, LATTICES["standard"])
    chosen = np.sort(rng.choice(VOXELS, rng.integers(0, 40), replace=False))
    is_new, gone = ~np.isin(chosen, held), rng.random(len(chosen)) < 0.4
    kind = np.where(is_new, ChangeClass.NEW, np.where(gone, ChangeClass.DELETED, ChangeClass.MODIFIED)).astype(np.uint8)
    there = kind != ChangeClass.DELETED
    changed = concat([gaussians(rng, chosen[there], REPORT), Gaussians.nothing_at(chosen[~there])])
    said = change_of(base if len(base) else None, sorted({*chosen.tolist(), 5}), changed, tile=tile)
    return base, replace(said, change_class=kind, unsure=met(rng, np.setdiff1d(VOXELS, [*held, *chosen])))


def met(rng, free):
    """What any vehicle may be unsure of, in voxels in which the map holds nothing; often nothing."""
    ids = np.sort(rng.choice(free, rng.choice([0, 1, 30]), replace=False))
    some, cells = gaussians(rng, ids, REPORT), rng.integers(1, 20, len(ids)).astype(np.int32)
    return snap(Gaussians(some.voxel_id, cells, cells.copy(), some.mean_m, some.cov_m2), REPORT)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_what_is_packed_comes_out_again_and_only_what_was_wanted(seed):
    rng = np.random.default_rng(seed)
    tiles = sorted((TILE, NEIGHBOUR)[: rng.integers(1, 3)])
    bases, changes = zip(*(change(rng, tile) for tile in tiles), strict=True)
    report = report_of(1, *changes)
    by_sha = {said.base_sha: base for base, said in zip(bases, changes, strict=True)}
    held = [Tile(said.tile, said.base_version, base) for base, said in zip(bases, changes, strict=True)]

    packed = PackedReport.decode(pack(report, by_sha, track_by()).encode())
    expanded = expand(packed, report.layer, report.district, held)
    assert [c.changed.voxel_id.tolist() for c in expanded.tiles] == [c.changed.voxel_id.tolist() for c in changes]
    assert [c.change_class.tolist() for c in expanded.tiles] == [c.change_class.tolist() for c in changes]
    assert not any(c.changed.exists.any() for c in expanded.tiles)
    assert [c.unsure for c in expanded.tiles] == [c.unsure for c in changes]
    assert not any(np.isin(c.observed, c.unsure.voxel_id).any() for c in expanded.tiles)

    mask = rng.random(askable(report)) < rng.random()
    wanted = encode_mask(mask)
    assert decode_mask(wanted, len(mask)).tolist() == mask.tolist()
    half = PackedGaussians.decode(pack_measured(report, by_sha, wanted).encode())
    assert half.wanted_crc == crc_of(wanted)
    whole = with_measured(expanded, {t.tile_id: t.gaussians for t in held}, mask, half.measured)
    asked = asked_voxels(expanded, mask)
    for said, found in zip(changes, whole.tiles, strict=True):
        ids = asked[said.tile]
        assert found.changed.select(ids) == said.changed.select(ids)
        assert found.changed.voxel_id[found.changed.exists].tolist() == ids.tolist()
        assert np.isin(said.changed.voxel_id, found.observed).all()
        assert (found.base_version, found.base_sha) == (said.base_version, said.base_sha)
