"""Particles moved until a body of fluid has its rest density everywhere."""
