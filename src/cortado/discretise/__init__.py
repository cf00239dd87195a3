"""Shapes, their particles and walls at the start, and smoothing kernels, in NumPy and float64."""
