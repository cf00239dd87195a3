"""Sweeps: one scene or task with many combinations of values, each in a folder of its own, and a table of them all."""
