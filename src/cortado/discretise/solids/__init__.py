"""Solids: how far points are from their surfaces, and where particles of walls stand beneath these."""
