"""Runs as files of other programs: meshes, points and solids over time, and labelled arrays."""
