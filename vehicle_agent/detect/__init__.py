"""Change detection by ray casting (GND section 4): rays -> evidence counters -> classes."""
