"""Warp kernels only, one physical term a file: each with its tangent and its adjoint. Nothing here launches.

Every factory is cached by (smoothing kernel, precision) and puts its kernels into one Warp module for that pair.
Sorted particles are numbered i; a ``_bar`` is an adjoint, a ``_dot`` a tangent.
"""
