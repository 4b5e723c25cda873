"""`gnd doctor`: what keeps the programs from working, on this machine or on the way to the cloud, and what to do."""
