"""Warp kernels only, one topic a file; those of a physical term with tangents and adjoints. Nothing here launches.

Factories are cached, and put their kernels into named Warp modules: one for each precision and smoothing kernel.
Sorted particles are numbered i; a ``_bar`` is an adjoint, a ``_dot`` a tangent.
"""
