"""Fits of parameters to measured experiments with error bars, from videos, sensors and tracks."""
