"""Features of HD maps in tiles: what they are, whether they exist, how they are written."""

from gnd.gnd_map.features.covariance import full_covariance, six_of, snapped_covariance
from gnd.gnd_map.features.existence import VACUOUS, Existence, combine, hit, miss, prior
from gnd.gnd_map.features.feature import (
    CUT_END,
    CUT_START,
    LAYERS_KNOWN,
    UNKNOWN_HEIGHT_M2,
    Feature,
    feature_id_of,
    is_feature_layer,
    snapped,
)
from gnd.gnd_map.features.feature_codec import (
    CODEC_FEATURES,
    MAX_FEATURES_OF_TILE,
    decode_features,
    encode_features,
)
from gnd.gnd_map.features.feature_tile import (
    FeatureDelta,
    FeatureTile,
    apply_features,
    decode_feature_delta,
    diff_features,
    encode_feature_delta,
    read_feature_delta,
)
from gnd.gnd_map.features.polylines import (
    check_simple_polyline,
    cut_polyline,
    geodetic_in_tile,
    join_pieces,
    pieces_of,
    points_in_tile,
)

__all__ = [
    "CODEC_FEATURES",
    "CUT_END",
    "CUT_START",
    "LAYERS_KNOWN",
    "MAX_FEATURES_OF_TILE",
    "UNKNOWN_HEIGHT_M2",
    "VACUOUS",
    "Existence",
    "Feature",
    "FeatureDelta",
    "FeatureTile",
    "apply_features",
    "check_simple_polyline",
    "combine",
    "cut_polyline",
    "decode_feature_delta",
    "decode_features",
    "diff_features",
    "encode_feature_delta",
    "encode_features",
    "feature_id_of",
    "full_covariance",
    "geodetic_in_tile",
    "hit",
    "is_feature_layer",
    "join_pieces",
    "miss",
    "pieces_of",
    "points_in_tile",
    "prior",
    "read_feature_delta",
    "six_of",
    "snapped",
    "snapped_covariance",
]
