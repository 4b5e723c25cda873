"""Simulated drives that make localisation fail: hills, leaves, company that keeps pace, and sensors that err."""
