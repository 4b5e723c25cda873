"""Keeps a LiDAR map up to date with a fleet of vehicles, over Zenoh."""
