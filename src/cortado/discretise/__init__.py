"""The rest lattice, smoothing kernels, shapes, packing and walls. NumPy, float64."""
