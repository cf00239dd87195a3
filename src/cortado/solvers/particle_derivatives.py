"""The tangent and the adjoint of a particle solver's step, without the pressure iterations of the solver."""

from functools import partial
from weakref import finalize

import warp as wp

from cortado.device.launching import CapturedGraph
from cortado.device.reduction import add
from cortado.particles.state import Fields, Parameters, State
from cortado.particles.wall_terms import SolidShares
from cortado.solvers.particles import ParticleSolver
from cortado.solvers.solver import WithinBar
from cortado.sph.free_solids import FreeSolidsAdjoint, FreeSolidsTangent
from cortado.sph.parts import Adjoints, Carried, Shares, StepContext, Tangents


class ParticleTangent:
    def __init__(self, solver: ParticleSolver, parameters_dot: Parameters):
        self._solver = solver
        fields = Fields.zeros(solver.layout.all_particles, solver.discretisation.precision, solver.device)
        self._parts = [part.new_tangent() for part in solver.parts]
        bodies = [own for part in self._parts if isinstance(part, FreeSolidsTangent) for own in part.bodies]
        self.carried_dot = Carried(solver.carried_fields, solver.layout)
        kick = solver.kick_of(self.carried_dot)
        self.dot = Tangents(fields, solver.new_fractions(), parameters_dot, bodies, kick)
        self.density = solver.density.new_tangent()
        self._accelerations_dot = [solver.vectors() for _ in range(len(solver.forces) + 1)]
        finalize(self, solver.launch.forget)

    def sort(self, context: StepContext, state_dot: State) -> None:
        solver, d = self._solver, self.dot.fields
        scene = {"x_scene": state_dot.positions, "v_scene": state_dot.velocities}
        scene["m_scene"] = state_dot["reference_density"]
        context.launch(solver.integration.sort, scene, d.named())
        self.carried_dot.sort(context, state_dot)
        for part in self._parts:
            part.begin(context, self.dot, state_dot)
        self.density.measure(context, self.dot)
        for part in self._parts:
            part.sort(context, self.dot, state_dot)

    def accelerate(self, context: StepContext) -> wp.array:
        for t, force in enumerate(self._solver.forces):
            force.tangent(context, self.dot, self._accelerations_dot[t], self._accelerations_dot[t + 1])
        return self._accelerations_dot[-1]

    def predict(self, context: StepContext, v_star: wp.array, x_star_dot: wp.array, v_star_dot: wp.array) -> None:
        """Write the predicted velocities, and the tangents of the predicted velocities and positions."""
        accelerations = {"acceleration": self._solver.accelerations[-1], "acceleration_dot": self.accelerate(context)}
        out = {"v_star": v_star, "x_star_dot": x_star_dot, "v_star_dot": v_star_dot}
        context.launch(self._solver.integration.predict_tangent, *self.dot.named, **accelerations, **out)

    def unsort(
        self, context: StepContext, x_dot: wp.array, v_dot: wp.array, state_dot: State, **carried_dot: wp.array
    ) -> None:
        solver = self._solver
        scene = {"x_scene": state_dot.positions, "v_scene": state_dot.velocities}
        context.launch(solver.integration.unsort, x=x_dot, v=v_dot, **scene)
        self.carried_dot.unsort(context, carried_dot, state_dot)
        for part in self._parts:
            part.end(context, self.dot, state_dot)


class ParticleAdjoint:
    """The adjoint of a step. The adjoints of the step's parts are applied in reverse order."""

    def __init__(self, solver: ParticleSolver, steps: int):
        layout = solver.layout
        of_parts = (name for part in solver.parts for name in part.shares)
        of_forces = (name for force in solver.forces for name in force.shares)
        names = ["time_step", *of_parts, *solver.shares, *of_forces]
        self._solver = solver
        self._parts = [part.new_adjoint() for part in reversed(solver.parts)]
        fields = Fields.zeros(layout.all_particles, layout.precision, layout.device)
        shares = Shares(names, layout), SolidShares(solver.search.moving, layout)
        bodies = [own for part in self._parts if isinstance(part, FreeSolidsAdjoint) for own in part.bodies]
        self.bar = Adjoints(fields, solver.new_fractions(), solver.new_parameters(steps), *shares, bodies)
        """Adjoints of a step. Call `collect` to sum the adjoints of parameters."""
        self.carried_bar = Carried(solver.carried_fields, solver.layout)
        """Adjoints of the solver's state fields, after `unsort`."""
        self.density, self._acceleration_bar = solver.density.new_adjoint(), solver.vectors()
        self._collect = CapturedGraph(partial(self.bar.shares.collect, self.bar.parameters), solver.launch)
        finalize(self, solver.launch.forget)

    def begin(self) -> None:
        self.bar.fractions.zero_()
        self.bar.shares.clear()
        self.bar.parameters.clear()
        self.bar.solids.clear()

    def collect(self) -> Parameters:
        self._collect()
        return self.bar.parameters

    def unsort(self, context: StepContext, state_bar: State) -> State:
        """Apply the adjoint of `ParticleSolver.unsort`. Return the adjoints of positions and velocities in scene order,
        before emitters and other parts prescribe values."""
        self.carried_bar.sort(context, state_bar)
        free_bar = state_bar
        for part in self._parts:
            free_bar = part.end(context, self.bar.parameters, state_bar, free_bar)
        return free_bar

    def begin_step(self, context: StepContext, free_bar: State, v_star: wp.array) -> None:
        """Write the adjoints of a step's final velocities and positions, given the result of `unsort`."""
        scene = {"x_scene_bar": free_bar.positions, "v_scene_bar": free_bar.velocities}
        context.launch(self._solver.integration.begin_adjoint, *self.bar.named, v_star=v_star, **scene)

    def predict(self, context: StepContext, within: WithinBar | None = None) -> None:
        """Apply the adjoint of velocity prediction and forces, and add the adjoints ``within`` the step."""
        fields = self.bar.fields
        if within is not None:
            add(within.v_star, fields["v"])
        own = {"acceleration_bar": self._acceleration_bar}
        context.launch(self._solver.integration.acceleration_adjoint, *self.bar.named, **own)
        self.accelerate(context, self._acceleration_bar)
        if within is not None:
            for given, total in zip(within.fields.arrays(), fields.arrays(), strict=True):
                add(given, total)

    def accelerate(self, context: StepContext, acceleration_bar: wp.array) -> None:
        for force in reversed(self._solver.forces):
            passed = force.adjoint(context, acceleration_bar, self.bar)
            acceleration_bar = acceleration_bar if passed is None else passed

    def mix(self, context: StepContext, state_bar: State) -> None:
        for part in self._parts:
            part.sort(context, self.bar, state_bar)

    def sort(self, context: StepContext, state_bar: State, **carried_bar: wp.array) -> None:
        solver, b = self._solver, self.bar.fields
        self.density.measure(context, self.bar)
        with context.aside():
            m_scene_bar = state_bar["reference_density"]
            context.launch(solver.integration.collect_masses, *self.bar.named, m_scene_bar=m_scene_bar)
        for part in self._parts:
            part.begin(context, self.bar, state_bar)
        scene = {"x_scene": state_bar.positions, "v_scene": state_bar.velocities}
        context.launch(solver.integration.unsort, x=b["x"], v=b["v"], **scene)
        self.carried_bar.unsort(context, carried_bar, state_bar)
        context.join()
