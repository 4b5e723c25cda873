"""Borders of lanes mapped by vehicles: from the reflectivity of paint under a LiDAR, and from what a camera sees."""
