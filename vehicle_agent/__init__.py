"""The vehicle's half of the loop: download, drive, localise, detect, report, upload."""
