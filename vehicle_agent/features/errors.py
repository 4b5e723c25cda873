"""Errors of the vehicle's feature layers. Messages carry numbers and say what to do."""

from gnd.vehicle_agent.errors import VehicleError


class FeatureLayerError(VehicleError):
    """Base of what SLAMCU raises: what it was given cannot be used; nothing of it was taken."""


class SlamcuParameterError(FeatureLayerError):
    """A parameter lies outside its range."""


class BadLook(FeatureLayerError):
    """A look whose columns differ in length, are not finite, or lie outside what a sensor can measure."""


class BadPose(FeatureLayerError):
    """A pose, covariance, motion or fix that is not finite, or a covariance that is none."""


class BadMapFeatures(FeatureLayerError):
    """Map features with an id twice, without a position, or with a covariance that is none."""
