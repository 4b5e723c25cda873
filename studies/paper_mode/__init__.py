"""The GND paper's own rules with both readings of ξ, beside the points of its Figures 15 to 17 and 23."""
