"""Which problem a search is of, so that it is not resumed with another one."""

from collections.abc import Sequence
from hashlib import sha256
from typing import Any

import numpy as np

from cortado.code_words import code_words
from cortado.losses import fingerprint
from cortado.scene.restart import RestartState
from cortado.simulation import Simulation
from cortado.sph.free_energy import FREE_ENERGIES
from cortado.sph.makers import fingerprint as parts_fingerprint


def fingerprint_of(simulation: Simulation, steps: int, loss: Any, states: Sequence[RestartState]) -> str:
    """A text of the parts of a problem that its values follow from; see `Problem.fingerprint`."""
    energy = simulation.free_energy
    parts = {
        "scene": simulation.scene.computed_json().encode(),
        "first positions": simulation.positions.tobytes(),
        "target and loss": fingerprint(loss).encode(),
    }
    checksums = [f"{name} {sha256(content).hexdigest()[:16]}" for name, content in parts.items()]
    for state in states:
        fields = b"".join(np.asarray(state[name]).tobytes() for name in sorted(state.fields))
        clock = repr(state.clock) + (f" {state.clock.time_step!r}" if state.clock.time_step else "")
        checksums.append(f"state {sha256(fields + clock.encode()).hexdigest()[:16]}")
    code = "" if energy in FREE_ENERGIES.values() else f" {code_words(energy.functions)}"
    energies = f"free energy {energy.name} {energy.curvature}{code}"
    own = {"forces": simulation.forces, "solver": [simulation.own_solver] if simulation.own_solver else []}
    told = [f"{what} {text}" for what, makers in own.items() if (text := parts_fingerprint(makers, simulation))]
    return "; ".join([f"{steps} steps", simulation.precision.name, *checksums, energies, *told])
