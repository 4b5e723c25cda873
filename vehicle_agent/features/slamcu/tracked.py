"""The features of one drive: the map's and the new ones, and which of them are estimated in the particles."""

from collections.abc import Collection
from math import nan

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.features.errors import BadMapFeatures
from gnd.vehicle_agent.features.look import MapFeatures
from gnd.vehicle_agent.features.slamcu.existence_book import BookEntry, ExistenceBook
from gnd.vehicle_agent.features.slamcu.parameters import SlamcuParameters
from gnd.vehicle_agent.features.slamcu.rbpf import Prior, Rbpf


class Tracked:
    """Entries of features, and their slots in the particles.

    Attributes:
        known: entries of the map's features, in its order.
        new: entries of the others.
        live: entries that are in the particles; the place in this list is the slot.
    """

    def __init__(self, parameters: SlamcuParameters, known: MapFeatures, rbpf: Rbpf, book: ExistenceBook) -> None:
        self._p, self._rbpf, self._book = parameters, rbpf, book
        self.known: list[BookEntry] = []
        self._known_xy_m = np.zeros((0, 2))
        self.new: list[BookEntry] = []
        self.live: list[BookEntry] = []
        self._numbers = 0
        self.hold(known)

    def hold(self, known: MapFeatures) -> None:
        """Further features of the map.

        Raises:
            BadMapFeatures: one of them is held already.
        """
        held = {entry.number for entry in self.known} & set(known.feature_id.tolist())
        if held:
            raise BadMapFeatures(f"{len(held)} features are held already, the first {min(held)}; forget them first")
        extra = np.eye(2) * self._p.map_sigma_m**2
        self.known += [self._of_map(known, i, known.cov[i] + extra) for i in range(len(known.feature_id))]
        self._index()

    def forget(self, feature_ids: Collection[int]) -> None:
        """Features of the map that matter no longer."""
        gone = set(feature_ids)
        for entry in [entry for entry in self.live if entry.known and entry.number in gone]:
            self.leave(entry)
        self.known = [entry for entry in self.known if entry.number not in gone]
        self._index()

    def _index(self) -> None:
        self._known_xy_m = np.array([entry.xy_m for entry in self.known]).reshape(-1, 2)

    def within(self, xy_m: F64, radius_m: float) -> list[BookEntry]:
        """Entries whose position lies within a radius of a place (2,)."""
        off = self._known_xy_m - xy_m
        known = np.flatnonzero(np.einsum("ni,ni->n", off, off) <= radius_m**2)
        new = [entry for entry in self.new if float(np.hypot(*(entry.xy_m - xy_m))) <= radius_m]
        return [self.known[i] for i in known] + new

    def register(self, kind: str) -> BookEntry:
        """A feature that nobody knew, without evidence so far; Eq. (4)."""
        self._numbers += 1
        entry = BookEntry(self._numbers, False, kind, np.zeros(2), None, nan, self._book.new_masses)
        self.new.append(entry)
        return entry

    def enter(self, entry: BookEntry, z: F64, variance: F64) -> None:
        """Estimate a feature in the particles from this first measurement on."""
        self._rbpf.add(z, variance, prior_of_entry(entry))
        entry.slot, entry.pass_hits, entry.pass_misses = len(self.live), 0, 0
        self.live.append(entry)

    def leave(self, entry: BookEntry) -> None:
        """Estimate it no longer."""
        if entry.slot is not None:
            self._rbpf.remove(entry.slot)
            self._forget_slot(entry)

    def drop(self, entry: BookEntry) -> None:
        """A new feature that was none."""
        self.leave(entry)
        self.new.remove(entry)

    def unite(self, kept: BookEntry, other: BookEntry) -> None:
        """The particles' estimates of two features become one, that of `kept`."""
        if other.slot is None:
            return
        if kept.slot is None:
            self.live[other.slot] = kept
            kept.slot, other.slot = other.slot, None
            kept.pass_hits, kept.pass_misses = other.pass_hits, other.pass_misses
            self._rbpf.priors[kept.slot] = prior_of_entry(kept)
        else:
            self._rbpf.merge(kept.slot, other.slot)
            self._forget_slot(other)

    def hand_over(self, giver: BookEntry, taker: BookEntry) -> None:
        """What was estimated for one feature turned out to be another."""
        assert giver.slot is not None
        self.live[giver.slot] = taker
        taker.slot, taker.pass_hits, taker.cov, giver.slot = giver.slot, giver.pass_hits, None, None
        self._rbpf.priors[taker.slot] = None

    def hand_back(self, giver: BookEntry, taker: BookEntry) -> None:
        """The new feature was the map's after all; it is given up."""
        if giver.slot is not None:
            self.live[giver.slot] = taker
            taker.slot, taker.pass_hits, taker.pass_misses = giver.slot, giver.pass_hits, giver.pass_misses
            self._rbpf.priors[taker.slot], giver.slot = prior_of_entry(taker), None
        self.drop(giver)

    def exchange(self, one: BookEntry, other: BookEntry) -> None:
        """The estimates of two features are each other's."""
        mine, others = one.slot, other.slot
        assert mine is not None
        assert others is not None
        for entry, slot in ((one, others), (other, mine)):
            entry.slot = slot
            self.live[slot], self._rbpf.priors[slot] = entry, prior_of_entry(entry)
        for name in ("pass_hits", "pass_misses", "in_view_s", "odometer_m", "heights"):
            before = getattr(one, name)
            setattr(one, name, getattr(other, name))
            setattr(other, name, before)

    def _forget_slot(self, entry: BookEntry) -> None:
        assert entry.slot is not None
        del self.live[entry.slot]
        entry.slot = None
        for slot, one in enumerate(self.live):
            one.slot = slot

    def _of_map(self, known: MapFeatures, i: int, cov: F64) -> BookEntry:
        packed = np.array([cov[0, 0], cov[0, 1], cov[1, 1]])
        number, kind, z_m = int(known.feature_id[i]), known.kind[i], float(known.z_m[i])
        return BookEntry(number, True, kind, known.xy_m[i].copy(), packed, z_m, self._book.known_masses)


def prior_of_entry(entry: BookEntry) -> Prior | None:
    """Its position known otherwise, if there is one."""
    return None if entry.cov is None else (entry.xy_m, entry.cov)
