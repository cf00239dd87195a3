"""How often the error bars of fits hold the truth, and what fits cost; see ``python -m benchmarks.fits --help``."""
