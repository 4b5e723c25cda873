"""A simulated street with known truth: worlds, LiDARs, drives, evaluation and pictures."""
