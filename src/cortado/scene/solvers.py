"""The table [solver] of a scene: the algorithm of a step, with its keys."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self, get_args

import numpy as np
from pydantic import Discriminator, Field, Tag, model_validator

from cortado.errors import InputError
from cortado.scene.packages import Inline, PackageTable
from cortado.scene.tables import Flag, OrWord, Table, Text, count, field_error, quantity

OWN = ("projection", "pcisph")
"""Kinds of Cortado's solvers; the first is the default."""
COURANT = 0.2
"""Default Courant number; with 0.3 and more PCISPH diverges in some scenes."""

Suits = tuple[tuple[str, Mapping[str, Any]], ...]
"""Names of tables, each with keys and values that belong together."""


class SolverTable(Table):
    """Algorithm and length of a step."""

    kind: str
    """Name of the algorithm."""
    time_step: Annotated[float | Literal["auto"], OrWord(quantity("s", gt=0.0), "auto")]
    """Length of a step [s]; "auto" chooses the length of each step before it."""
    courant: Annotated[float, quantity(gt=0.0, le=1.0)] | None = None
    """Courant number of adaptive time steps: the largest distance that the fastest particle moves in a step, in
    smoothing lengths (half a support radius); 0.2 if left out."""
    greatest_time_step: Annotated[float, quantity("s", gt=0.0)] | None = None
    """Upper bound of adaptive time steps [s]; needed if nothing else bounds them, as without gravity."""

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
        """Return True if the length of each step is chosen before it."""
        return self.time_step == "auto"

    def fixed_time_step(self, what: str) -> float:
        """Return the fixed length of a step [s], which ``what`` needs; raise `InputError` if steps are adaptive."""
        if self.time_step == "auto":
            raise InputError(f'solver.time_step is "auto", but must be a number of seconds for {what}.')
        return self.time_step


class ProjectionSolver(SolverTable):
    """A solver that projects velocities to zero divergence; its pressure may be negative inside the fluid."""

    kind: Literal["projection"] = "projection"
    """Name of the algorithm."""
    iterations: Annotated[int, count(2, 1_000)] = 2
    """Number of pressure iterations in every step, each starting from the last pressure; with a tolerance the
    minimum."""
    tolerance: Annotated[float, quantity(gt=0.0)] | None = None
    """Iterations end once the divergence is below this value, measured as the root mean square inside the fluid of the
    divergence times the time step. If left out, every step has the same number of iterations."""
    maximum_iterations: Annotated[int, count(1, 1_000_000)] = 50
    """Largest number of pressure iterations in a step, with a tolerance."""
    repairs: Annotated[int, count(1, 1_000)] = 2
    """Number of iterations in every step that move particles back to the rest density."""
    velocities_follow: Flag = False
    """If true, velocities are corrected when the shift and the repairs move a particle by delta: v + (delta · grad) v.
    Flows in full containers then lose less speed, but flows with a surface can gain energy."""
    suits: ClassVar[Suits] = (
        ("discretisation", {"kernel": "wendland_c2", "support": 2.6}),
        ("emitter", {"jitter": 0.05}),
    )
    """Values for other tables that set none of these keys; `docs/projection.md` has the measurements."""
    suits_without_surface: ClassVar[Suits] = (("discretisation", {"jitter": 0.05}),)
    """Values for other tables if all axes are periodic, where no surface disturbs the order of a lattice."""

    @model_validator(mode="after")
    def _check_iterations(self) -> Self:
        most = self.maximum_iterations
        if self.tolerance is None and most != type(self).model_fields["maximum_iterations"].default:
            raise field_error(("maximum_iterations",), most, "left out, as there is no tolerance")
        if self.tolerance is not None and self.iterations > most:
            raise field_error(("maximum_iterations",), most, f"at least iterations, {self.iterations}")
        return self


class PcisphSolver(SolverTable):
    """A solver by PCISPH, predictive-corrective incompressible SPH."""

    kind: Literal["pcisph"]
    """Name of the algorithm."""
    minimum_iterations: Annotated[int, count(1, 1_000_000)] = 3
    """Minimum number of pressure iterations in a step."""
    maximum_iterations: Annotated[int, count(1, 1_000_000)] = 50
    """Maximum number of pressure iterations in a step."""
    density_tolerance: Annotated[float, quantity(ge=0.0)] = 0.01
    """Iterations end once the average error of the density is below this value. The error of a particle is
    (rho - rho_0) / rho_0, or 0 where that is negative."""
    maximum_density_tolerance: Annotated[float, quantity(ge=0.0)] | None = None
    """Iterations end only once the maximum of (rho - rho_0) / rho_0 is below this value, too; no condition if left
    out."""

    @model_validator(mode="after")
    def _check_iterations(self) -> Self:
        if self.minimum_iterations > self.maximum_iterations:
            wanted = f"at most maximum_iterations, {self.maximum_iterations}"
            raise field_error(("minimum_iterations",), self.minimum_iterations, wanted)
        return self


class PackageSolver(SolverTable, PackageTable):
    """A solver that an installed package registers."""

    group = "cortado.solvers"
    method = "build"
    own = OWN
    kind: Annotated[Text, Field(json_schema_extra={"not": {"enum": list(OWN)}})]
    """Name of the solver in the package."""
    advice = f"{' or '.join(f'{chr(34)}{name}{chr(34)}' for name in OWN)}, or "


def what_suits(solver: Any, container: Any) -> Suits:
    """Return keys that suit a solver, given as a table or its contents, for other tables that set none of these
    keys."""
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
