"""The header of a drive as the metadata record of its MCAP file.

What older programs did not write (`deskew`, `sweep_ns`, `mount`, `mount_sigma`, `nowhere`, `stand_ins`)
is only written where it says something, and may be missing: such files keep their bytes.
"""

import zlib
from collections.abc import Mapping
from typing import Any, Final

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.schemas.drive import DriveHeader, MountSigma
from gnd.schemas.errors import DriveError

METADATA: Final = "gnd.drive"
_FIELDS: Final = (
    "drive_id",
    "vehicle",
    "sensor_model",
    "map_anchor_lat_rad",
    "map_anchor_lon_rad",
    "map_anchor_height_m",
    "source",
)


def metadata_of(header: DriveHeader) -> dict[str, str]:
    """The header, but for the mount, as strings under a CRC."""
    fields = {
        "drive_id": header.drive_id,
        "vehicle": header.vehicle,
        "sensor_model": header.sensor_model,
        "map_anchor_lat_rad": repr(float(header.anchor.lat_rad)),
        "map_anchor_lon_rad": repr(float(header.anchor.lon_rad)),
        "map_anchor_height_m": repr(float(header.anchor.height_m)),
        "source": header.source,
        **_newer_fields(header),
    }
    return fields | {"crc32": _crc_of(fields)}


def _newer_fields(header: DriveHeader) -> dict[str, str]:
    sigma = header.mount_sigma
    fields = {
        "deskew": "" if header.deskew == "unsaid" else header.deskew,
        "sweep_ns": str(header.sweep_ns) if header.sweep_ns else "",
        "mount": "" if header.mount == "unsaid" else header.mount,
        "mount_sigma": " ".join(repr(float(one)) for one in sigma) if sigma else "",
        "nowhere": "yes" if header.nowhere else "",
        "stand_ins": " ".join(header.stand_ins),
    }
    return {key: value for key, value in fields.items() if value}


def _newer_values(metadata: Mapping[str, str]) -> dict[str, Any]:
    """What `_newer_fields` wrote; `DriveError` where it is no number, `BadValue` comes from the header itself."""
    try:
        sweep_ns = int(metadata.get("sweep_ns", "0"))
        sigma = MountSigma(*map(float, metadata["mount_sigma"].split())) if "mount_sigma" in metadata else None
    except (ValueError, TypeError) as error:
        raise DriveError(f"metadata {METADATA!r}: sweep time or sigma of the mount is no number: {error}") from error
    told: dict[str, Any] = {key: metadata[key] for key in ("deskew", "mount") if key in metadata}
    told |= {"nowhere": "nowhere" in metadata, "stand_ins": tuple(metadata.get("stand_ins", "").split())}
    return {**told, "sweep_ns": sweep_ns, "mount_sigma": sigma}


def _crc_of(fields: Mapping[str, str]) -> str:
    """MCAP guards its chunks; metadata lies outside them, and a flipped digit of the anchor would move the map."""
    text = "\n".join(f"{key}={value}" for key, value in sorted(fields.items()) if key != "crc32")
    return f"{zlib.crc32(text.encode()):08x}"


def header_of(metadata: Mapping[str, str], T_vehicle_lidar: F64) -> DriveHeader:
    """The header in a metadata record and the mount; `DriveError` when the record is damaged or lacks a field."""
    missing = {"crc32", *_FIELDS} - metadata.keys()
    if missing:
        raise DriveError(f"metadata {METADATA!r} lacks {', '.join(sorted(missing))}")
    if metadata["crc32"] != _crc_of(metadata):
        raise DriveError(f"metadata {METADATA!r} is damaged: CRC {metadata['crc32']}, found {_crc_of(metadata)}")
    anchor = (float(metadata[f"map_anchor_{name}"]) for name in ("lat_rad", "lon_rad", "height_m"))
    return DriveHeader(
        drive_id=metadata["drive_id"],
        vehicle=metadata["vehicle"],
        sensor_model=metadata["sensor_model"],
        anchor=LocalFrame(*anchor),
        T_vehicle_lidar=T_vehicle_lidar,
        source=metadata["source"],
        **_newer_values(metadata),
    )
