"""Maps for the programs of others: Autoware, LAS, changes for a GIS, Foxglove and Rerun (docs/how_to/export_map.md)."""
