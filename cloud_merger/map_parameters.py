"""The parameters that a map depends on beside its reports, as a text that travels with the journal.

Whoever computes a version anew takes those with which it was made, whatever the defaults are by then.
"""

import json
from dataclasses import replace
from hashlib import sha256
from typing import Any, Final

from gnd.cloud_merger.caps import CAP_MODEL_BEYOND, CAP_MODEL_VOICES, CAP_OWNER_BEYOND, CAP_OWNER_VOICES
from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.confirmation import (
    CONFIRMATION_SECOND_DRIVE_S,
    CONFIRMATION_VOUCHED_SHARE,
    CONFIRMATION_WELL_KNOWN_M,
    ConfirmationParameters,
)
from gnd.cloud_merger.errors import MergerError
from gnd.cloud_merger.features.association import FEATURE_LINE_REACH_M
from gnd.cloud_merger.features.drive_shift import FEATURE_SHIFT_DOUBTED_FROM
from gnd.cloud_merger.features.existence import FEATURE_ABSENCE, FEATURE_CEILING, FEATURE_PRIOR, FEATURE_VIEW_MARGIN_M
from gnd.cloud_merger.features.parameters import FEATURE_GATE, FeatureMergeParameters
from gnd.cloud_merger.features.publication import FEATURE_MOST_WEIGHT, FEATURE_RENEWAL_MASS, FEATURE_VOTERS
from gnd.cloud_merger.features.tracks import FEATURE_MAX_BEGUN, FEATURE_MOVED_M
from gnd.cloud_merger.hearing import (
    HEARD_LEAST_OTHERS,
    HEARD_LEAST_VOXELS,
    HEARD_MISSED,
    HEARD_WRONG_CLAIMS,
)
from gnd.cloud_merger.parameters import (
    MERGE_D_DENIED,
    MERGE_D_RENEWED,
    MERGE_D_UPDATE,
    MERGE_NOISE_M,
    MERGE_POSE_LEVER_M,
    MERGE_XI_RESHAPED,
    MergeParameters,
)
from gnd.cloud_merger.parked import (
    PARKED_FREE_SHARE,
    PARKED_FREE_WEIGHT,
    PARKED_MOST_H,
    PARKED_PLACE_GOINGS,
    PARKED_SEEN_SHARE,
    PARKED_THERE_SHARE,
)
from gnd.cloud_merger.shift import (
    SHIFT_BEYOND_CHANCE,
    SHIFT_DISPLACED_M,
    SHIFT_EXPLAINED_SHARE,
    SHIFT_FITS,
    SHIFT_LEAST_GAUSSIANS,
    SHIFT_MAX_M,
    SHIFT_MAX_RAD,
    SHIFT_REFUTED_SHARE,
)
from gnd.gnd_map.bounded import json_value
from gnd.gnd_map.config import from_mapping, to_mapping
from gnd.gnd_map.errors import ConfigError
from gnd.gnd_map.foliage import BOUNDS as SEASON_BOUNDS
from gnd.gnd_map.settings import merged
from gnd.gnd_map.vehicle_shape import BOUNDS
from gnd.schemas.feature_layer import LayerParameters

_FORMAT: Final = 1
_GROUPS: Final[dict[str, type[Any]]] = {
    "merge": MergeParameters,
    "confirmation": ConfirmationParameters,
    "features": FeatureMergeParameters,
}
_CONSTANTS: Final[dict[str, dict[str, float]]] = {
    "merge": {
        "xi_reshaped": MERGE_XI_RESHAPED,
        "d_update": MERGE_D_UPDATE,
        "d_denied": MERGE_D_DENIED,
        "d_renewed": MERGE_D_RENEWED,
        "noise_m": MERGE_NOISE_M,
        "pose_lever_m": MERGE_POSE_LEVER_M,
    },
    "confirmation": {
        "vouched_share": CONFIRMATION_VOUCHED_SHARE,
        "well_known_m": CONFIRMATION_WELL_KNOWN_M,
        "second_drive_s": CONFIRMATION_SECOND_DRIVE_S,
    },
    "hearing": {
        "cap_model_beyond": CAP_MODEL_BEYOND,
        "cap_model_voices": CAP_MODEL_VOICES,
        "cap_owner_beyond": CAP_OWNER_BEYOND,
        "cap_owner_voices": CAP_OWNER_VOICES,
        "least_others": HEARD_LEAST_OTHERS,
        "least_voxels": HEARD_LEAST_VOXELS,
        "missed": float(HEARD_MISSED),
        "wrong_claims": float(HEARD_WRONG_CLAIMS),
    },
    "parked": {
        "most_h": PARKED_MOST_H,
        "place_goings": PARKED_PLACE_GOINGS,
        "seen_share": PARKED_SEEN_SHARE,
        "there_share": PARKED_THERE_SHARE,
        "free_share": PARKED_FREE_SHARE,
        "free_weight": PARKED_FREE_WEIGHT,
    },
    "vehicle_shape": BOUNDS,
    "season": SEASON_BOUNDS,
    "shift": {
        "max_m": SHIFT_MAX_M,
        "max_rad": SHIFT_MAX_RAD,
        "least_gaussians": SHIFT_LEAST_GAUSSIANS,
        "fits": SHIFT_FITS,
        "explained_share": SHIFT_EXPLAINED_SHARE,
        "beyond_chance": SHIFT_BEYOND_CHANCE,
        "displaced_m": SHIFT_DISPLACED_M,
        "refuted_share": SHIFT_REFUTED_SHARE,
    },
    "features": {
        "gate": FEATURE_GATE,
        "line_reach_m": FEATURE_LINE_REACH_M,
        "moved_m": FEATURE_MOVED_M,
        "prior": FEATURE_PRIOR,
        "absence": FEATURE_ABSENCE,
        "view_margin_m": FEATURE_VIEW_MARGIN_M,
        "voters": FEATURE_VOTERS,
        "most_weight": FEATURE_MOST_WEIGHT,
        "renewal_mass": FEATURE_RENEWAL_MASS,
        "max_begun": FEATURE_MAX_BEGUN,
        "shift_doubted_from": FEATURE_SHIFT_DOUBTED_FROM,
        "ceiling": FEATURE_CEILING,
    },
}
"""What the map depends on and nobody sets. It travels, too: a release with another value knows that it has one."""


def text_of(config: ShardConfig) -> str:
    """The canonical text: JSON with sorted keys. Equal parameters give equal texts; floats come back bit for bit."""
    said: dict[str, Any] = merged(_CONSTANTS, {name: to_mapping(getattr(config, name)) for name in _GROUPS})
    if config.feature_layer:
        said["feature_layer"] = [to_mapping(layer) for layer in config.feature_layer]
    return json.dumps(said | {"codec": config.codec, "format": _FORMAT}, sort_keys=True, separators=(",", ":"))


def has_hearing(text: str) -> bool:
    """Whether a text is of rules by which who is clearly wrong in a tile has no vote there; "" is of older ones."""
    return bool(text) and "hearing" in json_value(text)


def judges_met(text: str) -> bool:
    """Whether a text is of rules by which what several met and none decides upon is one witness's word, and denied as
    claims are. "" and older texts are of rules that added it up, whoever told of it, and judged nobody by it.
    """
    return bool(text) and "together" in json_value(text)["merge"]


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
        said = json_value(text)
        if said["format"] != _FORMAT:
            raise MergerError(f"parameters of format {said['format']}, this release reads {_FORMAT}")
        said["confirmation"].setdefault("parked_h", 0.0)  # made when nothing was held back for its shape
        said["merge"].setdefault("together", True)  # made when what vehicles met was always added up
        _take_constants(said)
        groups = {name: from_mapping(kind, said[name], where=name) for name, kind in _GROUPS.items()}
        declared = tuple(from_mapping(LayerParameters, table) for table in said.get("feature_layer", ()))
        return replace(config, codec=said["codec"], feature_layer=declared, **groups)
    except (ValueError, KeyError, TypeError, AttributeError, ConfigError) as error:
        raise MergerError(
            f"merge parameters {digest_of(text)[:16]}… cannot be read by this release: {error}"
        ) from error


def _take_constants(said: dict[str, Any]) -> None:
    """Take the constants out of a text, which is changed.

    Raises:
        MergerError: one has another value in this release.
    """
    for group, constants in _CONSTANTS.items():
        for name, value in constants.items():
            told = said.get(group, {}).pop(name, value)
            if told != value:
                raise MergerError(f"{group}.{name} is {told!r}; it is {value!r} in this release, and nobody sets it")
