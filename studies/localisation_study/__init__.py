"""Localisation in a changed world (GND, sections 6.2, 7.2, 7.6): errors beside the paper's tables and Ford's limits."""
