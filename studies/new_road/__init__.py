"""Roads that the map does not have: a street whose map is cut, mapped by vehicles."""
