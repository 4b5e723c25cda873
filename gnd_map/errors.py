"""Errors of the whole project hang below `GndError`; those of this package below `MapError`.

GndError
├── ConfigError      a configuration value or key that cannot be used
└── MapError
    ├── RegionError  a region that is no wildcard, tile or circle
    ├── TileError    a tile id, path, district or voxel id that does not exist
    ├── GeodesyError a position that is no position (not finite, latitude beyond a pole, near the Earth's centre)
    ├── ShapeError   an array of the wrong shape, type or order, or with values that are not finite
    ├── CodecError   bytes that are no encoded Gaussians
    ├── DeltaError   a delta that does not fit the tile
    ├── MotionError  poses that do not cover the time asked for
    ├── FeatureError a feature that is none (no position, no covariance, masses that do not sum to 1, ...)
    └── TrackError   a track that no vehicle drives, or that is too long
"""


class GndError(Exception):
    """Base of every error that this project raises on purpose; the command line prints it as one line."""


class ConfigError(GndError):
    """A configuration key is unknown, or a value has the wrong type or range."""


class MapError(GndError):
    """Base of the errors of `gnd_map`."""


class TileError(MapError):
    """A tile id, tile path, district or voxel id that does not exist."""


class RegionError(MapError):
    """A region that is neither a wildcard, nor a tile, nor a circle."""


class GeodesyError(MapError):
    """A position outside the domain of the geodetic formulas."""


class ShapeError(MapError):
    """An array has the wrong shape, type or order, or holds values that are not finite."""


class CodecError(MapError):
    """Bytes are truncated, too long, or do not decode to valid Gaussians."""


class DeltaError(MapError):
    """A delta removes what the tile does not hold."""


class MotionError(MapError):
    """A time lies outside the poses that are known."""


class TrackError(MapError):
    """A track that no vehicle drives, or more of it than its limits allow."""


class FeatureError(MapError):
    """A feature without a place, with a covariance that is none, or masses that do not sum to 1."""
