"""Poles, trunks, lamp posts and sign posts in LiDAR scans, by geometry alone."""
