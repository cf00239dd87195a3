"""Predictive-corrective incompressible SPH (Solenthaler and Pajarola 2009)."""
