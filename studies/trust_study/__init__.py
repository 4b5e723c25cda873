"""What bad vehicles can do to the map, and who is named for it: `gnd reproduce trust`."""
