"""The velocity projection: its pressures push and pull, and it keeps particles evenly spaced."""
