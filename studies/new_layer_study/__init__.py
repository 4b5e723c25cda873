"""Simulation and experiment of the paper on new feature layers (Kim, Cho, Sunwoo and Jo 2018, sections 5 and 6)."""
