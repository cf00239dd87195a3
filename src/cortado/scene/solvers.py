"""The table [solver] of a scene: the algorithm of a step and its keys."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self, get_args

import numpy as np
from pydantic import Discriminator, Field, Tag, model_validator

from cortado.errors import InputError
from cortado.scene.packages import Inline, PackageTable
from cortado.scene.tables import Flag, OrWord, Table, Text, count, field_error, quantity

OWN = ("projection", "pcisph")
"""Names of Cortado's solvers. The first solver is the default."""
COURANT = 0.2
Suits = tuple[tuple[str, Mapping[str, Any]], ...]
"""For each table, the name of the table and the default values of its keys."""


class SolverTable(Table):
    """The algorithm and the length of a time step."""

    kind: str
    """Name of the algorithm."""
    time_step: Annotated[float | Literal["auto"], OrWord(quantity("s", gt=0.0), "auto")]
    """Length of a step [s]. With "auto", the solver chooses the length anew before each step."""
    courant: Annotated[float, quantity(gt=0.0, le=1.0)] | None = None
    """Courant number of adaptive time steps; 0.2 if left out. The fastest particle moves at most this number of
    smoothing lengths in a time step. A smoothing length is half a support radius."""
    greatest_time_step: Annotated[float, quantity("s", gt=0.0)] | None = None
    """Greatest adaptive time step [s]. Scenes without gravity may need this key."""

    @model_validator(mode="before")
    @classmethod
    def _refuse_keys_of_others(cls, data: Any) -> Any:
        own = (ProjectionSolver, PcisphSolver)
        for other in own if cls in own and isinstance(data, Mapping) else ():
            for name in [name for name in data if name in other.model_fields and name not in cls.model_fields]:
                kind = get_args(other.model_fields["kind"].annotation)[0]
                raise field_error((name,), data[name], f'left out, as only the solver "{kind}" has it')
        return data

    @model_validator(mode="after")
    def _check_time_step(self) -> Self:
        for name in ("courant", "greatest_time_step") if not self.chooses else ():
            if getattr(self, name) is not None:
                raise field_error((name,), getattr(self, name), 'left out, as time_step is not "auto"')
        return self

    @property
    def chooses(self) -> bool:
        """True if time steps are adaptive."""
        return self.time_step == "auto"

    def fixed_time_step(self, what: str) -> float:
        """Return the fixed time step [s]. Raise `InputError`, with ``what`` as the reason, for adaptive time steps."""
        if self.time_step == "auto":
            raise InputError(f'solver.time_step is "auto", but must be a number of seconds for {what}.')
        return self.time_step


class ProjectionSolver(SolverTable):
    """A solver that projects velocities to zero divergence. The solver's pressure may be negative inside the fluid."""

    kind: Literal["projection"] = "projection"
    iterations: Annotated[int, count(2, 1_000)] = 2
    """Number of pressure iterations in every step, or the minimum if `tolerance` is given."""
    tolerance: Annotated[float, quantity(gt=0.0)] | None = None
    """Tolerance of the pressure iterations: greatest root mean square of divergence times time step, inside the fluid.
    If left out, every step has the same number of iterations."""
    maximum_iterations: Annotated[int, count(1, 1_000_000)] = 50
    """Greatest number of pressure iterations in a step if `tolerance` is given."""
    repairs: Annotated[int, count(1, 1_000)] = 2
    """Number of density iterations in every step. Density iterations move particles until the fluid has its rest
    density."""
    velocities_follow: Flag = False
    """If true, velocities are adapted to the new positions when a step shifts particles. Flows in full containers then
    lose less speed than otherwise, but flows with a free surface can gain energy."""
    suits: ClassVar[Suits] = (
        ("discretisation", {"kernel": "wendland_c2", "support": 2.6}),
        ("emitter", {"jitter": 0.05}),
    )
    """Default values of keys in other tables; see `docs/projection.md`."""
    suits_without_surface: ClassVar[Suits] = (("discretisation", {"jitter": 0.05}),)
    """Default values of keys in other tables, for scenes in which all axes are periodic."""

    @model_validator(mode="after")
    def _check_iterations(self) -> Self:
        most = self.maximum_iterations
        if self.tolerance is None and most != type(self).model_fields["maximum_iterations"].default:
            raise field_error(("maximum_iterations",), most, "left out, as there is no tolerance")
        if self.tolerance is not None and self.iterations > most:
            raise field_error(("maximum_iterations",), most, f"at least iterations, {self.iterations}")
        return self


class PcisphSolver(SolverTable):
    """The solver PCISPH: predictive-corrective incompressible SPH."""

    kind: Literal["pcisph"]
    minimum_iterations: Annotated[int, count(1, 1_000_000)] = 3
    """Minimum number of pressure iterations in a step."""
    maximum_iterations: Annotated[int, count(1, 1_000_000)] = 50
    """Maximum number of pressure iterations in a step."""
    density_tolerance: Annotated[float, quantity(ge=0.0)] = 0.01
    """Tolerance of the average density error of all particles. The error of a particle is (density - rest density) /
    rest density; a negative error counts as 0."""
    maximum_density_tolerance: Annotated[float, quantity(ge=0.0)] | None = None
    """Tolerance of the greatest density error of a particle; no limit if left out."""

    @model_validator(mode="after")
    def _check_iterations(self) -> Self:
        if self.minimum_iterations > self.maximum_iterations:
            wanted = f"at most maximum_iterations, {self.maximum_iterations}"
            raise field_error(("minimum_iterations",), self.minimum_iterations, wanted)
        return self


class PackageSolver(SolverTable, PackageTable):
    """A solver from an installed package."""

    group = "cortado.solvers"
    method = "build"
    own = OWN
    kind: Annotated[Text, Field(json_schema_extra={"not": {"enum": list(OWN)}})]
    """Name of the solver in the package."""
    advice = f"{' or '.join(f'{chr(34)}{name}{chr(34)}' for name in OWN)}, or "


def what_suits(solver: Any, container: Any) -> Suits:
    """Return the defaults that a solver sets in other tables. Each argument is a table or a dict."""
    if _table_of(solver) != "ProjectionSolver":
        return ()
    periodic = container.get("periodic") if isinstance(container, Mapping) else getattr(container, "periodic", None)
    full = periodic is not None and np.all(periodic)
    return (*ProjectionSolver.suits, *(ProjectionSolver.suits_without_surface if full else ()))


def _table_of(solver: Any) -> str:
    kind = solver.get("kind", OWN[0]) if isinstance(solver, Mapping) else getattr(solver, "kind", OWN[0])
    if kind == "pcisph":
        return "PcisphSolver"
    return "PackageSolver" if isinstance(kind, str) and kind.strip() and kind not in OWN else "ProjectionSolver"


AnySolver = Annotated[
    Annotated[ProjectionSolver, Tag("ProjectionSolver")]
    | Annotated[PcisphSolver, Tag("PcisphSolver")]
    | Annotated[PackageSolver, Tag("PackageSolver"), Inline()],
    Discriminator(_table_of),
]
