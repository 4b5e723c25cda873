"""Feature layers of a map as a file: JSON that names layers and tiles, with each tile as its published bytes."""

import base64
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from gnd.fleet_sim.errors import WorldError
from gnd.fleet_sim.strict_json import items, mapping, parsed
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.features import FeatureTile, decode_features, encode_features, is_feature_layer
from gnd.gnd_map.tile_id import TileId

_FORMAT: Final = "gnd.features"
_VERSION: Final = 1
_MAX_FILE_BYTES: Final = 64 * 1024 * 1024


def write_feature_layers(layers: Mapping[str, Sequence[FeatureTile]], path: Path) -> None:
    """Write feature layers, tiles by layer; the file appears complete or not at all.

    Raises:
        WorldError: the file cannot be written.
    """
    told = {layer: [_told(tile) for tile in tiles] for layer, tiles in sorted(layers.items())}
    partial = path.with_name(path.name + ".part")
    try:
        text = json.dumps({"format": _FORMAT, "version": _VERSION, "layers": told}, indent=1)
        partial.write_text(text + "\n", encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise WorldError(f"cannot write the feature layers {path}: {error}") from error


def _told(tile: FeatureTile) -> dict[str, object]:
    body = base64.b64encode(encode_features(tile.features)).decode("ascii")
    return {"tile": tile.tile_id.path, "version": tile.version, "features": len(tile.features), "body": body}


def read_feature_layers(path: Path) -> dict[str, tuple[FeatureTile, ...]]:
    """Read feature layers.

    Raises:
        WorldError: the file is missing, too large, or none of these.
    """
    try:
        size = path.stat().st_size
        if size > _MAX_FILE_BYTES:
            raise WorldError(f"feature layers {path} have {size} bytes, the limit is {_MAX_FILE_BYTES}")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise WorldError(f"cannot read the feature layers {path}: {error}") from error
    where = f"feature layers {path}"
    data = mapping(parsed(text, where), where)
    if (data.get("format"), data.get("version")) != (_FORMAT, _VERSION):
        raise WorldError(f'{where} are not "{_FORMAT}" of version {_VERSION}')
    layers = mapping(data.get("layers"), f"{where}, layers")
    return {
        _layer(name, where): tuple(_tile(t, f"{where}, {name}") for t in items(listed, name))
        for name, listed in layers.items()
    }


def _layer(name: str, where: str) -> str:
    if not is_feature_layer(name):
        raise WorldError(f"{where}: {name[:40]!r} is no feature layer")
    return name


def _tile(value: object, where: str) -> FeatureTile:
    data = mapping(value, where)
    try:
        body = base64.b64decode(str(data.get("body")), validate=True)
        return FeatureTile(TileId.from_path(str(data.get("tile"))), int(data.get("version", 0)), decode_features(body))
    except (GndError, ValueError, TypeError, OverflowError) as error:
        raise WorldError(f"{where}, tile {str(data.get('tile'))[:40]!r}: {error}") from error
