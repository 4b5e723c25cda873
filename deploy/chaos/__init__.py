"""The whole cloud as real processes, hurt in every way that a seed draws, and then looked at from outside."""
