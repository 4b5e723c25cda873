"""Packets of Ouster's sensors: metadata, layout of packets, frames, points."""
