"""The simulation of the GND paper (sections 6 and 7): worlds with known truth, single drives, fleets, their scores."""
