"""`gnd lab`: a fleet over real links, each in a network namespace of its own with rate, delay, jitter and loss."""
