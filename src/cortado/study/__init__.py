"""The gradient study: gradients by many ways side by side, one experiment a file, each with its numbers and a picture.

An experiment is a TOML file in ``experiments/``, a `experiment.Kind` measures, draws and judges it, and
``cortado gradients figure`` does all three. A new kind is a module here, and an entry in ``kinds.py``.
"""
