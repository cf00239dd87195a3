"""The rest lattice, smoothing kernels, shapes, packing and walls, in NumPy and float64."""
