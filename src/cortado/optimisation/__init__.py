"""Optimisers, what they work on, in which coordinates, and how a search is resumed."""
