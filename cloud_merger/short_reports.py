"""Reports in short: what their flags say, which Gaussians are wanted, and what the two halves say together."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.errors import BadReport, MissingBase
from gnd.cloud_merger.expanding import base_versions, expand, is_askable, with_measured
from gnd.cloud_merger.in_play import TilesInPlay
from gnd.cloud_merger.parameters import MergeParameters
from gnd.cloud_merger.stored import Bases, said
from gnd.cloud_merger.waiting import Promises
from gnd.cloud_merger.wants import Known, WantParameters, asked_voxels, wanted
from gnd.gnd_map.codec import decode_mask, encode_mask
from gnd.gnd_map.errors import CodecError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.keys import parse_change_key
from gnd.schemas.packed import PackedGaussians, PackedReport
from gnd.tile_store.store import Store
from gnd.tile_store.uploads import FirstHalf

_NO_BASE: Final = b""


@dataclass(frozen=True, slots=True, eq=False)
class FirstSaid:
    """What flags say.

    Attributes:
        report: expanded, all Gaussians withheld.
        mask: (N,) bool, of which of its new and modified voxels Gaussians are wanted.
        hopeless: tiles of which nothing that it flags could win.
    """

    report: ChangeReport
    mask: NDArray[np.bool_]
    hopeless: frozenset[TileId] = frozenset()

    @property
    def wanted(self) -> bytes:
        """The mask as it travels; b"": nothing is wanted."""
        return encode_mask(self.mask) if self.mask.any() else b""


class ShortReports:
    """Understands the halves of packed reports. Safe in several threads.

    Args:
        store: of tiles and reports.
        merge: how statements will be merged.
        want: which Gaussians are asked for.
        bases: versions of tiles in memory.
    """

    def __init__(self, store: Store, merge: MergeParameters, want: WantParameters, bases: Bases) -> None:
        self.promises = Promises()
        self._store, self._merge, self._want = store, merge, want
        self._bases = bases
        self._in_play = TilesInPlay(store, merge, self._bases)

    def expanded(self, key: str, packed: PackedReport) -> ChangeReport:
        """The report that the flags stand for, all Gaussians withheld.

        Raises:
            MissingBase: the store does not hold what the vehicle compared with.
            BadReport, SchemaError: the flags cannot be a report.
        """
        layer, district = parse_change_key(key)
        bases = [self._tile(layer, *one) for one in base_versions(packed, district)]
        return expand(packed, layer, district, bases)

    def decided(self, report: ChangeReport) -> FirstSaid:
        """An expanded report with what is wanted of it, by what the store holds now."""
        known = {c.tile: self._known(report, c) for c in report.tiles if is_askable(c).any()}
        found = wanted(report, known, self._merge, self._want)
        return FirstSaid(report, found.mask, found.hopeless)

    def asks(self, first: FirstSaid) -> None:
        """The vehicle is asked: until its Gaussians come, others are not asked for the same."""
        asked = asked_voxels(first.report, first.mask)
        self.promises.note(first.report.report_id, first.report.layer, asked)

    def completed(self, key: str, first: FirstHalf, gaussians: PackedGaussians) -> tuple[ChangeReport, ...]:
        """What flags in the journal and their Gaussians say together: a report for each tile that Gaussians came of.

        Raises:
            MissingBase: a base has gone meanwhile.
            BadReport, SchemaError: the Gaussians cannot be those that were asked for.
        """
        layer, district = parse_change_key(key)
        tiles = [tile for tile, _ in base_versions(PackedReport.decode(first.body), district)]
        parts = [said(row.body) for row in self._store.first_parts(layer, first.journal_id, tiles)]
        if len(parts) != len(tiles):
            raise MissingBase(
                f"report {gaussians.report_id}: {len(parts)} of its {len(tiles)} tiles are in the journal"
            )
        whole = replace(parts[0], tiles=tuple(change for part in parts for change in part.tiles))
        bases = {change.tile: self._base(layer, change) for change in whole.tiles}
        measured = with_measured(whole, bases, _mask(first, whole.tiles), gaussians.measured)
        return tuple(
            replace(measured, tiles=(now,))
            for before, now in zip(whole.tiles, measured.tiles, strict=True)
            if now is not before
        )

    def _tile(self, layer: str, tile: TileId, version: int) -> Tile:
        found = self._bases.version(layer, tile, version)
        if found is None:
            raise MissingBase(f"tile {tile} of layer {layer} has no version {version} here")
        return found

    def _base(self, layer: str, change: TileChange) -> Gaussians:
        found = self._bases.content(layer, change.tile, change.base_sha) if change.base_sha else Gaussians.empty()
        if found is None:
            raise MissingBase(f"tile {change.tile}: version {change.base_version} has gone since its flags came")
        return found

    def _known(self, report: ChangeReport, change: TileChange) -> Known:
        tile = self._in_play.of(report.layer, change.tile)
        shas = {*tile.votes.shas, change.base_sha} - {_NO_BASE}
        found = {sha: self._bases.content(report.layer, change.tile, sha) for sha in sorted(shas)}
        return Known(
            epoch=tile.state.gaussians,
            memory=tile.state.memory,
            votes=tile.votes,
            bases={sha: gaussians for sha, gaussians in found.items() if gaussians is not None},
            promised=self.promises.of(change.tile, report.layer, but=report.report_id),
        )


def _mask(first: FirstHalf, changes: Sequence[TileChange]) -> NDArray[np.bool_]:
    try:
        return decode_mask(first.wanted, sum(int(is_askable(change).sum()) for change in changes))
    except CodecError as error:
        raise BadReport(f"the mask of {len(first.wanted)} bytes that asked cannot be read: {error}") from error
