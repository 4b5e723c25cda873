"""Roads of the feature studies in the plane: seeded routes with map features, drives along them, what detectors see.

No LiDAR ray is cast here; detections carry the noise models of the papers (Jo et al. 2018, Kim et al. 2018).
"""
