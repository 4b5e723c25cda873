"""Results on a place with known truth: how the map heals with the number of drives, and the exact tiles that result."""

import hashlib

import numpy as np
import pytest
from merger_world import change_of, report_id, sha_of

from gnd.cloud_merger.merge import MergeParameters, merge_tile
from gnd.cloud_merger.statements import Report, statements_of
from gnd.gnd_map.codec import encode_gaussians
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.similarity import similarity

N = 600  # voxels: the first half holds Gaussians in the map
SHAPES = np.array([[0.28, 0.28, 0.03], [0.03, 0.28, 0.28], [0.03, 0.03, 0.28], [0.2, 0.2, 0.2]])


def random_gaussians(rng, ids):
    """A Gaussian of a random place and shape in each voxel."""
    cov = np.zeros((len(ids), 6), np.float32)
    cov[:, [0, 3, 5]] = SHAPES[rng.integers(0, len(SHAPES), len(ids))] ** 2
    mean = rng.uniform(-0.25, 0.25, (len(ids), 3)).astype(np.float32)
    return Gaussians(ids, rng.integers(50, 500, len(ids), np.int32), np.full(len(ids), 60, np.int32), mean, cov)


def joined(*parts):
    """The later part wins."""
    rows = {int(v): part.take([k]) for part in parts for k, v in enumerate(part.voxel_id)}
    columns = zip(*(rows[v].columns for v in sorted(rows)), strict=True)
    return Gaussians(*(np.concatenate(column) for column in columns))


class Place:
    """A map, the world as it is now, and vehicles that see it with errors, parked cars included."""

    def __init__(self, seed=5):
        self.rng = np.random.default_rng(seed)
        ids = np.arange(N, dtype=np.int32)
        self.map = random_gaussians(self.rng, ids[: N // 2])
        self.new, self.gone, self.modified = ids[N // 2 : N // 2 + 40], ids[:40], ids[40:70]
        now = joined(self.map, random_gaussians(self.rng, np.concatenate([self.modified, self.new])))
        self.world = now.take(~np.isin(now.voxel_id, self.gone))
        self.changed = np.concatenate([self.new, self.gone, self.modified])

    def report(self, number):
        """One drive: sees 80 % of the voxels, misses 10 % of the changes, meets parked cars in 8 % of the rest."""
        rng = self.rng
        observed = np.flatnonzero(rng.random(N) < 0.8).astype(np.int32)
        seen = observed[np.isin(observed, self.changed) & (rng.random(len(observed)) < 0.9)]
        free = observed[observed >= N // 2 + 40]
        cars = random_gaussians(rng, free[rng.random(len(free)) < 0.08])
        there = self.world.select(seen)
        noise = rng.normal(0, 0.015, there.mean_m.shape).astype(np.float32)
        there = Gaussians(*there.columns[:3], there.mean_m + noise, there.cov_m2)
        said = joined(Gaussians.nothing_at(seen), there, cars)
        return Report(report_id(number), change_of(self.map, observed.tolist(), said))

    def merged(self, reports, mode):
        statements = statements_of(self.map, reports, {sha_of(self.map): self.map}, mode)
        return merge_tile(self.map, statements, MergeParameters(mode=mode)).gaussians

    def errors(self, got):
        """How many voxels are not as in the world."""
        return sum(bool(self.is_wrong(got.select([v]), self.world.select([v]))) for v in range(N))

    def is_wrong(self, a, b):
        if len(a) == 0 or len(b) == 0:
            return len(a) != len(b)
        return similarity(a.exists, a.mean_m, a.cov_m2, b.exists, b.mean_m, b.cov_m2, "default")[0] < 0.5


@pytest.fixture(scope="module")
def healing():
    """Wrong voxels after 0, 1, 3, 9 and 20 drives, by mode."""
    place = Place()
    reports = [place.report(number) for number in range(20)]
    return {
        mode: [place.errors(place.merged(reports[:n], mode)) for n in (0, 1, 3, 9, 20)] for mode in ("default", "paper")
    }


def test_the_map_heals_with_every_few_drives(healing):
    stale, one, three, nine, twenty = healing["default"]
    assert stale > one > three > nine >= twenty
    assert twenty <= 2


def test_the_denominator_of_the_paper_publishes_parked_cars_the_more_the_more_vehicles_drive(healing):
    _, one, _, nine, twenty = healing["paper"]
    assert one < nine < twenty
    assert twenty > 10 * max(healing["default"][-1], 1)


@pytest.mark.parametrize(("mode", "digest"), [("default", "fec742460ba87848"), ("paper", "b428dda5fa434684")])
def test_the_merged_tile_is_the_same_bit_for_bit_in_every_release(mode, digest):
    place = Place(seed=11)
    got = place.merged([place.report(number) for number in range(7)], mode)
    assert hashlib.sha256(encode_gaussians(got)).hexdigest()[:16] == digest
