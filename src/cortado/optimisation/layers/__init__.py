"""Cortado as a layer of other programs: differentiable functions of named arrays, and bridges to JAX and PyTorch."""
