"""Are the gradients of a problem right, and how long do they mean something? `certify` finds out."""

from cortado.certificate.certificate import Certificate, certify
from cortado.certificate.rightness import Comparison

__all__ = ["Certificate", "Comparison", "certify"]
