"""The gradient study: gradients computed in many ways, compared in experiments with numbers and a picture each.

An experiment is a TOML file in ``experiments/``; its type (`experiment.ExperimentType`) measures, draws and judges it,
and ``python -m experiments figure`` does all three. A new type is a module here, and an entry in ``registry.py``.
"""
