"""`gnd reproduce traffic`: what a map and its changes weigh on the way (GND paper, section 7.5 and Figure 23)."""
