"""`gnd bench agent`: what a vehicle costs, by stage, alone on this machine."""
