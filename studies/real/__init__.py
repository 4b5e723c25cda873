"""Change detection on recordings of real sensors, with objects inserted ray-accurately: `gnd reproduce real`."""
