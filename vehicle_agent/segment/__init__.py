"""Motion segmentation: points on moving objects are found before evidence is counted ([50] in GND)."""

from gnd.vehicle_agent.segment.parameters import SegmentParameterError, SegmentParameters
from gnd.vehicle_agent.segment.segmenter import MotionSegmenter, SegmentedScan

__all__ = ["MotionSegmenter", "SegmentParameterError", "SegmentParameters", "SegmentedScan"]
