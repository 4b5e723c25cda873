"""Families of simulated places, each drawn by seed: the usual street, and those that are harder for the detector."""
