"""Data sets of runs with varied scenes, for learned simulators."""
