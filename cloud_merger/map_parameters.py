"""The parameters that a map depends on beside its reports, as a text that travels with the journal.

Whoever computes a version anew takes those with which it was made, whatever the defaults are by then.
"""

import json
from dataclasses import replace
from hashlib import sha256
from typing import Any, Final

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.confirmation import ConfirmationParameters
from gnd.cloud_merger.errors import MergerError
from gnd.cloud_merger.features.parameters import FeatureMergeParameters
from gnd.cloud_merger.parameters import MergeParameters
from gnd.cloud_merger.shift import ShiftParameters
from gnd.gnd_map.config import from_mapping, to_mapping
from gnd.gnd_map.errors import ConfigError

_FORMAT: Final = 1
_GROUPS: Final[dict[str, type[Any]]] = {
    "merge": MergeParameters,
    "confirmation": ConfirmationParameters,
    "shift": ShiftParameters,
    "features": FeatureMergeParameters,
}


def text_of(config: ShardConfig) -> str:
    """The canonical text: JSON with sorted keys. Equal parameters give equal texts; floats come back bit for bit."""
    said = {name: to_mapping(getattr(config, name)) for name in _GROUPS}
    return json.dumps(said | {"codec": config.codec, "format": _FORMAT}, sort_keys=True, separators=(",", ":"))


def digest_of(text: str) -> str:
    """What a text is told from others by: its SHA-256 in hex."""
    return sha256(text.encode()).hexdigest()


def with_text(config: ShardConfig, text: str) -> ShardConfig:
    """A configuration with the parameters of a text; "": as it is.

    Raises:
        MergerError: the text cannot be read, or is of a release that has other parameters.
    """
    if not text:
        return config
    try:
        said = json.loads(text)
        if said["format"] != _FORMAT:
            raise MergerError(f"parameters of format {said['format']}, this release reads {_FORMAT}")
        groups = {name: from_mapping(kind, said[name], where=name) for name, kind in _GROUPS.items()}
        return replace(config, codec=said["codec"], **groups)
    except (ValueError, KeyError, TypeError, ConfigError) as error:
        raise MergerError(
            f"merge parameters {digest_of(text)[:16]}… cannot be read by this release: {error}"
        ) from error
