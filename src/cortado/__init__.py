"""Cortado: a differentiable SPH fluid simulator with verified gradients.

A first example::

    scene = cortado.Scene(
        dimension=2,
        discretisation={"spacing": 0.04},  # m
        phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 1.0}],  # kg/m3, Pa s
        fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [0.4, 0.4], "phase": "water"}],
        container={"shape": "box", "lower": [0.0, 0.0], "upper": [0.8, 0.8]},
        solver={"time_step": 0.002},  # s
    )
    simulation = cortado.Simulation(scene, precision="float64")
    gauge = cortado.sensors.WaveGauge([0.2, 0.0])
    trajectory = simulation.run(40, record_every=10, sensors={"gauge": gauge})
    print(trajectory.sensors["gauge"]["height"])
    cortado.pictures.write_picture("last.png", trajectory.picture())
    problem = cortado.Problem(simulation, 20, cortado.losses.SensorMatch(gauge, [0.31]))
    value, gradient = problem.value_and_gradient({"gravity": [0.5, -9.81], "viscosity": 1.0})

The command ``cortado new dam`` writes a commented scene file, which ``cortado.Simulation("dam.toml")`` reads. The
command ``cortado schema`` prints all keys with their meanings. Names are imported when they are first used.
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


_MODULES = "executors forces gradients image_losses losses measured optimisers pictures render sensors"
_NAMES = {
    "certificate": "certify",
    "errors": "ComputationError CortadoError CortadoWarning DivergedError InputError SceneError",
    "optimisation.fitting.fit": "Fit fit",
    "optimisation.optimise": "evaluate optimise optimize",
    "pictures.several_runs": "film_side_by_side",
    "problem": "Problem",
    "runs.trajectory": "Trajectory",
    "scene.scene": "Scene load_scene",
    "simulation": "Simulation",
}
_HOMES = {name: home for home, names in _NAMES.items() for name in names.split()}
__all__ = [*_MODULES.split(), *_HOMES]

if not TYPE_CHECKING:  # which would take any name for one of the package
    __getattr__ = getter(__name__, _HOMES)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
