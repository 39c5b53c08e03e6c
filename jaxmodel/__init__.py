"""Model of a planar 3-PRR parallel robot with three flexible links: pure functions on pytrees."""
