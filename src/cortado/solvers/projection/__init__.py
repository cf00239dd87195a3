"""The projection of velocities to zero divergence, with pressures that may be negative."""
