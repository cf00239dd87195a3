"""Smoothing kernels, shapes, and what the rest lattice and its neighbourhoods tell. NumPy, float64."""
