"""`gnd serve`: a map in the browser, as it is, as it was, and as it changes."""
