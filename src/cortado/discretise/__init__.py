"""A scene cut into particles, with walls. NumPy, float64."""
