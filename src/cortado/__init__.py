"""Cortado: a differentiable SPH fluid simulator with verified gradients.

Names are imported when they are first used, so that ``import cortado`` is quick.
"""

from cortado.lazy import getter
from cortado.version import __version__ as __version__

TYPE_CHECKING = False  # that of typing, which takes as long to import as all else here
if TYPE_CHECKING:
    from cortado import executors as executors
    from cortado import forces as forces
    from cortado import gradients as gradients
    from cortado import image_losses as image_losses
    from cortado import jax as jax
    from cortado import losses as losses
    from cortado import measured as measured
    from cortado import optimisers as optimisers
    from cortado import pictures as pictures
    from cortado import render as render
    from cortado import sensors as sensors
    from cortado import torch as torch
    from cortado.certificate import certify as certify
    from cortado.errors import ComputationError as ComputationError
    from cortado.errors import CortadoError as CortadoError
    from cortado.errors import CortadoWarning as CortadoWarning
    from cortado.errors import DivergedError as DivergedError
    from cortado.errors import InputError as InputError
    from cortado.errors import SceneError as SceneError
    from cortado.optimisation.fitting.fit import Fit as Fit
    from cortado.optimisation.fitting.fit import fit as fit
    from cortado.optimisation.optimise import evaluate as evaluate
    from cortado.optimisation.optimise import optimise as optimise
    from cortado.optimisation.optimise import optimize as optimize
    from cortado.pictures.several_runs import film_side_by_side as film_side_by_side
    from cortado.problem import Problem as Problem
    from cortado.runs.trajectory import Trajectory as Trajectory
    from cortado.scene.scene import Scene as Scene
    from cortado.scene.scene import load_scene as load_scene
    from cortado.simulation import Simulation as Simulation


_MODULES = (
    "executors",
    "forces",
    "gradients",
    "image_losses",
    "losses",
    "measured",
    "optimisers",
    "pictures",
    "render",
    "sensors",
)
_HOMES = {
    "ComputationError": "errors",
    "CortadoError": "errors",
    "CortadoWarning": "errors",
    "DivergedError": "errors",
    "Fit": "optimisation.fitting.fit",
    "InputError": "errors",
    "Problem": "problem",
    "Scene": "scene.scene",
    "SceneError": "errors",
    "Simulation": "simulation",
    "Trajectory": "runs.trajectory",
    "certify": "certificate",
    "evaluate": "optimisation.optimise",
    "film_side_by_side": "pictures.several_runs",
    "fit": "optimisation.fitting.fit",
    "load_scene": "scene.scene",
    "optimise": "optimisation.optimise",
    "optimize": "optimisation.optimise",
}
__all__ = [*_MODULES, *_HOMES]

if not TYPE_CHECKING:  # which would take any name for one of the package
    __getattr__ = getter(__name__, _HOMES)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
