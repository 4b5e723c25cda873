"""Roads that the map does not have: surveys of vehicles become draft tiles, and tiles once several drives agree."""
