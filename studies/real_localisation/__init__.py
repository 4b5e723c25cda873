"""Odometry, localisation, registration and georeferencing on real recordings: `gnd reproduce real-localisation`."""
