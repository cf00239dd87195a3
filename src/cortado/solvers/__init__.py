"""Algorithms for a step: what a solver is, what all of them are made of, and PCISPH."""
