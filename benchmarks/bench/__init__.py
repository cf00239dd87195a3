"""What ``python -m benchmarks bench`` measures: a dam break, pass by pass, beside what the hardware allows."""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if not TYPE_CHECKING:
    __getattr__ = getter(__name__)
