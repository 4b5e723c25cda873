"""Clients of the tile server: tiles are fetched in batches, new versions followed, lost notices found."""
