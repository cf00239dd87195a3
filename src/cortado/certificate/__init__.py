"""Are the gradients of a problem right, and up to how many steps are they useful? `certify` finds out."""

from cortado.certificate.certificate import Certificate, certify
from cortado.certificate.consistency import Consistency

__all__ = ["Certificate", "Consistency", "certify"]
