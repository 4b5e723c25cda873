"""The lattice's kernels against their twins in plain numpy: the same integers and the same bits."""

from dataclasses import fields

import numpy as np
import pytest
from codec_samples import TILES, street

from gnd.gnd_map.codec import LATTICES, REPORT, Lattice, snap
from gnd.gnd_map.codec.lattice import Integers, _floats, _found, _found_plain, dequantise, quantise
from gnd.gnd_map.gaussian import Gaussians, concat, six_entries

ALL = [*LATTICES.values(), REPORT]


def wild(rng: np.random.Generator, n: int) -> Gaussians:
    """Gaussians of every shape: balls, planes, lines, points, means up to the limit."""
    root = rng.normal(size=(n, 3, 3)) * 10.0 ** rng.uniform(-4.0, 0.2, (n, 1, 3))
    cov = six_entries(root @ root.transpose(0, 2, 1)).astype(np.float32)
    count = rng.integers(1, 5000, n).astype(np.int32)
    mean = rng.uniform(-0.6, 0.6, (n, 3)).astype(np.float32)
    return Gaussians(np.arange(n, dtype=np.int32), count, np.minimum(count, 20).astype(np.int32), mean, cov)


@pytest.mark.parametrize("lattice", ALL, ids=lambda lattice: lattice.name)
def test_integers_are_found_as_numpy_finds_them(lattice: Lattice) -> None:
    rng = np.random.default_rng(7)
    free = wild(rng, 400)
    for gaussians in (free, snap(free, lattice), street(TILES[0], rng, 300), snap(street(TILES[0], rng, 300), lattice)):
        (found, on), (plain, plain_on) = _found(gaussians, lattice), _found_plain(gaussians, lattice)
        np.testing.assert_array_equal(on, plain_on)
        for field in fields(found):
            np.testing.assert_array_equal(getattr(found, field.name), getattr(plain, field.name), err_msg=field.name)
    assert _found(snap(free, lattice), lattice)[1].all()
    assert not _found(free, lattice)[1].any()


@pytest.mark.parametrize("lattice", ALL, ids=lambda lattice: lattice.name)
def test_floats_are_those_of_numpy(lattice: Lattice) -> None:
    integers = quantise(street(TILES[0], np.random.default_rng(3), 500), lattice)
    made, (mean_m, cov_m2) = dequantise(integers, lattice), _floats(integers, lattice)
    np.testing.assert_array_equal(made.mean_m, mean_m)
    np.testing.assert_array_equal(made.cov_m2, cov_m2)


@pytest.mark.parametrize("lattice", ALL, ids=lambda lattice: lattice.name)
def test_a_part_of_a_tile_has_the_integers_that_it_has_alone(lattice: Lattice) -> None:
    rng = np.random.default_rng(5)
    free, on = street(TILES[0], rng, 300), snap(street(TILES[0], rng, 300), lattice)
    mixed = concat([free.take(np.arange(100)), on.select(on.voxel_id[~np.isin(on.voxel_id, free.voxel_id[:100])])])
    for gaussians in (free, on, mixed):
        whole = Integers.of(gaussians, lattice)
        for kept in (*(rng.random((4, len(gaussians))) < 0.7), whole.is_on, np.zeros(len(gaussians), np.bool_)):
            alone = Integers.of(gaussians.take(kept), lattice)
            part, expected = whole.nearest(kept), alone.nearest(np.ones(len(alone.is_on), np.bool_))
            for field in fields(part):
                np.testing.assert_array_equal(getattr(part, field.name), getattr(expected, field.name))
