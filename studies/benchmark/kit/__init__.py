"""What travels with every export: the scorer and an example. They need Python and numpy, and nothing of ours."""
