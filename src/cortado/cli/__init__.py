"""The command line. ``cortado`` without arguments shows what it can do.

Exit codes: 0 for success, 1 if the computation or a check failed, 2 for wrong input, 130 after an interruption. Errors
are printed to stderr as one sentence, without a traceback.
"""

from cortado.cli.process import main

__all__ = ["main"]
