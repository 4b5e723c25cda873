"""Staged release: what vehicles tell of a tile on trial, and what becomes of versions."""
