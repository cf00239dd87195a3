"""A renderer as a layer: from the particles of a state to a picture of them."""

from typing import Any

import numpy as np

from cortado.device.threads import WARP
from cortado.errors import InputError, MissingDerivativeError, shown
from cortado.optimisation.layers.layer import Layer, Named, OneByOne, Shapes, on_host
from cortado.render import Renderer

PICTURE = "picture"
"""The name of what it returns."""


class Picture(Layer):
    """Pictures of a renderer. Its arrays are positions (n, d) [m] and, where wanted, mass fractions (n, phases) and
    colours (phases, 3). They pass through the host."""

    def __init__(self, renderer: Renderer):
        super().__init__()
        if not isinstance(renderer, Renderer):
            raise InputError(f"renderer is {shown(renderer)}, but must be one such as simulation.renderer() gives.")
        self._renderer = renderer
        self.real, self.device = renderer.precision.numpy, renderer.device
        self.kept_bytes = sum(int(np.prod(shape)) for shape in renderer.inputs.values()) * renderer.precision.bytes

    def check(self, given: Shapes) -> None:
        wanted = self._renderer.inputs
        if "positions" not in given:
            raise InputError(f"positions is left out, but must be an array {wanted['positions']}.")
        for name, shape in given.items():
            if shape != wanted[name]:
                raise InputError(f"{name} has shape {shape}, but must have {wanted[name]}.")

    def outputs(self) -> dict[str, tuple[int, ...]]:
        return {PICTURE: self._renderer.shape}

    @WARP
    def evaluate(self, given: Named, keep: bool) -> tuple[Named, Any]:
        own = {name: np.array(on_host(array)) for name, array in given.items()}
        return {PICTURE: self._renderer.render(**own)}, own if keep else None

    @WARP
    def pull(self, residual: dict[str, np.ndarray], bars: Named) -> Named:
        self._renderer.render(**residual)  # whose last picture may be another one
        found = self._renderer.adjoint(on_host(bars[PICTURE]).astype(np.float64))
        positions = found.positions.numpy()[:, : residual["positions"].shape[1]]
        all_found = {"positions": positions, "fractions": found.fractions.numpy(), "colours": found.colours}
        return {name: np.array(all_found[name]) for name in residual}

    def push(self, residual: dict[str, np.ndarray], dots: Named) -> Named:
        raise MissingDerivativeError("A picture has derivatives in reverse mode only: take a gradient.")

    def check_mapped(self) -> None:
        pass

    def many(self, size: int) -> Layer:
        return OneByOne(self, size)
