"""Where a version comes from, as bytes: its report ids, and for each changed voxel which of them (zlib of JSON)."""

import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from gnd.gnd_map.bounded import inflated, json_value
from gnd.tile_store.errors import StoreError


@dataclass(frozen=True, slots=True)
class Provenance:
    """Report ids, sorted, and voxel id → indices into them."""

    report_ids: tuple[str, ...]
    voxels: Mapping[int, tuple[int, ...]]

    @classmethod
    def of(cls, report_ids: tuple[str, ...], voxel_reports: Mapping[int, tuple[str, ...]]) -> "Provenance":
        """From the ids of a version and of each voxel; a voxel's ids belong to the version's, too."""
        ids = tuple(sorted(set(report_ids).union(*voxel_reports.values())))
        index = {report_id: i for i, report_id in enumerate(ids)}
        voxels = {voxel: tuple(sorted(index[one] for one in named)) for voxel, named in sorted(voxel_reports.items())}
        return cls(ids, voxels)

    def of_voxels(self) -> dict[int, tuple[str, ...]]:
        """Voxel id → report ids."""
        return {voxel: tuple(self.report_ids[i] for i in indices) for voxel, indices in self.voxels.items()}


NOTHING: Final = Provenance((), {})
_MAX_BYTES: Final = 1 << 25


def encode_provenance(provenance: Provenance) -> bytes:
    """Bytes that `decode_provenance` reads; b"" for nothing."""
    if not provenance.report_ids:
        return b""
    return zlib.compress(json.dumps([provenance.report_ids, list(provenance.voxels.items())]).encode())


def decode_provenance(data: bytes) -> Provenance:
    """The inverse of `encode_provenance`; StoreError when the bytes are damaged."""
    if not data:
        return NOTHING
    try:
        report_ids, voxels = json_value(inflated(data, _MAX_BYTES))
        return Provenance(tuple(report_ids), {voxel: tuple(indices) for voxel, indices in voxels})
    except (ValueError, TypeError) as error:
        raise StoreError(f"provenance of {len(data)} bytes is damaged: {error}") from None
