"""The command line; ``cortado`` alone shows what it can do.

Exit codes: 0 done, 1 the computation failed (or a check did), 2 the input is wrong, 130 interrupted. A mistake of the
user's, or of the machine, is one sentence on stderr, never a traceback.
"""

from cortado.cli.process import main

__all__ = ["main"]
