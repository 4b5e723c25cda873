"""How well "modified" is decided, by fitted trees and by plain thresholds: `gnd reproduce modified`."""
