"""`certify` tests if the gradients of a problem are right, and up to how many steps they are useful."""

from cortado.certificate.certificate import Certificate, certify
from cortado.certificate.consistency import Consistency

__all__ = ["Certificate", "Consistency", "certify"]
