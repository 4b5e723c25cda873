"""Geodesy, tiles, voxels, Gaussians, evidence and codecs: the core that knows no files, no network and no clock."""
