"""Fits of measured experiments: parameters with error bars, from videos, sensors and tracks."""
