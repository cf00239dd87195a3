"""Inverse problems from files: a scene, what is asked of it, and how to find it."""
