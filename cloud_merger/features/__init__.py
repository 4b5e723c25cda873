"""The cloud merge of feature layers."""

from gnd.cloud_merger.features.merge import MergedFeatures, merge_features, merge_layer
from gnd.cloud_merger.features.parameters import FeatureMergeParameters
from gnd.cloud_merger.features.spread import spread

__all__ = ["FeatureMergeParameters", "MergedFeatures", "merge_features", "merge_layer", "spread"]
