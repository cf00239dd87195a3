"""Walls: their particles in layers, and what each counts for in the density."""
