"""Import options as they are kept in a store, for the way back."""

from collections.abc import Mapping
from typing import Any

from gnd.tile_store.feature_io.errors import FeatureFileError
from gnd.tile_store.feature_io.placement import Placement
from gnd.tile_store.feature_io.values import ImportOptions


def about_options(options: ImportOptions) -> dict[str, Any]:
    """What `options_about` reads."""
    return {
        "layers": dict(options.layers),
        "other": options.other,
        "placement": options.placement.as_dict() if options.placement else None,
        "trust_latlon": options.trust_latlon,
        "height_offset_m": options.height_offset_m,
        "sigma_m": options.sigma_m,
        "sigma_up_m": options.sigma_up_m,
        "exist": options.exist,
        "strict": options.strict,
    }


def options_about(told: Mapping[str, Any]) -> ImportOptions:
    """The options that `about_options` told; FeatureFileError when they are none."""
    try:
        placement = told["placement"]
        return ImportOptions(**{**told, "placement": Placement.from_dict(placement) if placement else None})
    except (KeyError, TypeError) as error:
        raise FeatureFileError(f"no options of an import: {type(error).__name__}: {error}") from None
