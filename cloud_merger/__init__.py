"""Merger shards: take reports in, merge tiles, publish versions (GND section 5)."""
