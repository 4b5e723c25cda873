"""Settings for the property tests: machines that run them differ in speed, so no deadline for one example."""

from hypothesis import settings

settings.register_profile("no_deadline", deadline=None, max_examples=60)
settings.load_profile("no_deadline")
