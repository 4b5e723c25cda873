"""The whole cloud as real processes under seeded faults, then checked from outside."""
