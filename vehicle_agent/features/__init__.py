"""Features on the vehicle: what it sees of them, whether they exist, where they are (SLAMCU, NFL)."""
