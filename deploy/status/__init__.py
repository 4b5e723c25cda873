"""`gnd status`: how the cloud and its vehicles stand, and what an operator should look at."""
