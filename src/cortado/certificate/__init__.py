"""Certificates: `certify` tests whether gradients of a problem are right, and for how many steps they are useful."""

from cortado.certificate.certificate import Certificate, certify
from cortado.certificate.consistency import Consistency

__all__ = ["Certificate", "Consistency", "certify"]
