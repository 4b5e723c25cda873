"""`gnd localise`: one recorded drive on the map of a tile store; poses, health, errors, pictures."""
