"""`gnd load`: the reports of a few kept drives, sent again as those of many vehicles on many streets."""
