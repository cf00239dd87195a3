"""Inverse problems from files: a scene, a target, and how the parameters that lead to it are estimated."""
