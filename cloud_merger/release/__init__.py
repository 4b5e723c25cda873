"""Staged release: a new version goes to a share of the fleet first, and to all when nobody fares worse on it."""
