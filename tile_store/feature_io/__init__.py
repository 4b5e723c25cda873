"""Files of features (Lanelet2, OpenDRIVE, GeoJSON, Argoverse 2) into the feature layers of a store, and out of them."""
