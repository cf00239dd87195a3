"""Quantities of particles that a state does not hold but decides: density, pressure, speed, vorticity."""
