"""Roads that the map does not have: submaps by odometry, satellites and the edges of the map, uploaded as a survey."""
