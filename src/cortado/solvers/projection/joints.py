"""Hinges of a step of the projection, with derivatives: see `cortado.solvers.projection.joint_kernels`."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.launching import Named
from cortado.particles.state import Layout, zeros
from cortado.scene.hinges import Joint
from cortado.solvers.projection.joint_kernels import ROW, joint_kernels
from cortado.sph.free_solids import FreeSolidsPart
from cortado.sph.parts import Adjoints, StepContext, Tangents

Arrays = dict[str, wp.array]
GUARD = {"float32": 1e-5, "float64": 1e-10}
"""Part of its trace added to each diagonal block of K, which makes lambda 0 along directions in which neither body can
move. Along the axis of a hinge, where K of the angles is 0, the whole trace is added."""
BARS = ("turned_before_bar", "after_bar", "turned_bar")


class JointArrays:
    """Arrays of the hinges in a step, or tangents or adjoints with names that end in ``suffix``."""

    def __init__(self, rows: int, layout: Layout, suffix: str = ""):
        matrix, vector, self._suffix = layout.precision.matrix, layout.precision.vector, suffix
        kinds = {**dict.fromkeys(ROW, matrix), "apart": vector}
        sizes = {f"{name}{suffix}": (layout.members, kind) for name, kind in kinds.items()}
        self.rows = [zeros(sizes, layout.device) for _ in range(rows)]
        many = {"blocks": (rows * rows, matrix), "wanted": (rows, vector), "pushes": (rows, vector)}
        self.whole = zeros(
            {f"{name}{suffix}": ((count, layout.members), kind) for name, (count, kind) in many.items()}, layout.device
        )
        """K, b and lambda of all rows (`cortado.solvers.projection.joint_kernels`)."""
        blocks, wanted, pushes = self.whole.values()
        self.entries = [{f"wanted{suffix}": wanted[k], f"push{suffix}": pushes[k]} for k in range(rows)]
        """For each row its b, ``wanted``, and its lambda, ``push``."""
        self.blocks = {(k, n): {f"block{suffix}": blocks[k * rows + n]} for k in range(rows) for n in range(rows)}

    def side(self, k: int, other: bool) -> Arrays:
        """Return the matrices ``give`` and ``take`` of a row for the hinge's first or second body."""
        way = "other_" if other else ""
        return {f"{name}{self._suffix}": self.rows[k][f"{way}{name}{self._suffix}"] for name in ("give", "take")}

    def clear(self) -> None:
        for group in (*self.rows, self.whole):
            for array in group.values():
                array.zero_()


@dataclass(frozen=True)
class Row:
    """Three equations of a hinge."""

    joint: Joint
    straight: bool
    """True for the row that keeps the axis, False for the row that keeps the point."""

    @property
    def share(self) -> float:
        """Return 1 if lambda is a momentum, 0 if lambda is an angular momentum."""
        return 0.0 if self.straight else 1.0

    @property
    def sides(self) -> list[tuple[int, bool]]:
        """Return the numbers of the row's free bodies, each with True for the hinge's second solid."""
        return [(body, other) for body, other in ((self.joint.body, False), (self.joint.other, True)) if body >= 0]


@dataclass(frozen=True)
class Pair:
    """A row and a column of K that a body couples."""

    block: tuple[int, int]
    body: int
    far: tuple[bool, bool]
    """For row and column, True if the body is the hinge's second solid."""


class Joints:
    """The hinges of one solver."""

    def __init__(self, part: FreeSolidsPart, joints: Sequence[Joint], layout: Layout):
        self.part, self.layout = part, layout
        space = part.made_of.dimension == 3
        self.rows = [
            Row(joint, straight)
            for joint in joints
            for straight in (False, True)
            if not straight or (space and joint.axis is not None)
        ]
        count, matrix = len(self.rows), layout.precision.matrix
        self.own = JointArrays(count, layout)
        kinds = {"factors": ((count * count, layout.members), matrix), "inverses": ((count, layout.members), matrix)}
        self.factors = zeros(kinds, layout.device)
        self.pairs = [
            Pair((k, n), body, (other, far))
            for k, row in enumerate(self.rows)
            for n, column in enumerate(self.rows)
            for body, other in row.sides
            for same, far in column.sides
            if same == body
        ]

    @cached_property
    def kernels(self) -> SimpleNamespace:
        """Make the kernels on first use, because scenes without hinges need none."""
        return joint_kernels(self.layout.precision)

    def poses(self, row: Row) -> tuple[Named, ...]:
        """Return the poses of both solids of a row, with tangents, and the poses at the start of the run."""
        joint, each = row.joint, self.part.made_of.walls.each
        named = {**each[self.number(row)], **{f"other_{name}": array for name, array in each[joint.against].items()}}
        known: dict[str, Any] = {} if joint.axis is None else {"axis": self.layout.precision.vector(*joint.axis)}
        for way, begun in zip(("", "other_"), joint.begun, strict=True):
            known[f"{way}middle"] = self.layout.precision.vector(*begun.middle)
            known[f"{way}begun"] = self.layout.precision.matrix(*begun.turn.ravel())
        return named, known

    def number(self, row: Row) -> int:
        return self.part.bodies[row.joint.body].table.number

    def frame(self, row: Row) -> Any:
        return self.kernels.lean if row.straight else self.kernels.point

    def coefficients(self, pair: Pair) -> Named:
        """Return the arguments of `weigh` for one of `pairs`."""
        row, column = (self.rows[k] for k in pair.block)
        own = {"row_share": row.share, "share": column.share, "sign": 1.0 if pair.far[0] == pair.far[1] else -1.0}
        guard = GUARD[self.layout.precision.name] if row is column else 0.0
        return {**own, "guard": guard, "along": float(row is column and row.straight)}

    def sides(self, arrays: JointArrays, pair: Pair) -> Arrays:
        """Return ``take`` of the row and ``give`` of the column of one of `pairs`."""
        take, give = (arrays.side(k, far) for k, far in zip(pair.block, pair.far, strict=True))
        return {name: (take if name.startswith("take") else give)[name] for name in take}

    def begin(self, step: StepContext) -> None:
        members = self.layout.members
        self.own.whole["blocks"].zero_()
        for row, arrays in zip(self.rows, self.own.rows, strict=True):
            place = {"place": step.parameters[f"{row.joint.name}.position"]}
            step.launch(self.frame(row).forward, arrays, place, *self.poses(row), threads=members)
        for pair in self.pairs:
            known = self.sides(self.own, pair), self.coefficients(pair), self.own.blocks[pair.block]
            step.launch(self.kernels.weigh.forward, *known, *self.part.bodies[pair.body].known(step), threads=members)
        if self.rows:
            step.launch(self.kernels.factor, self.own.whole, self.factors, rows=len(self.rows), threads=members)

    def solve(self, step: StepContext, wanted: wp.array, pushes: wp.array, transposed: int = 0) -> None:
        """Write -K^-1 times ``wanted``; with ``transposed``, use the transpose of K."""
        known = {"rows": len(self.rows), "transposed": transposed, "wanted": wanted, "pushes": pushes}
        if self.rows:
            step.launch(self.kernels.solve, self.factors, known, threads=self.layout.members)

    def read(self, step: StepContext, moved: Sequence[Arrays]) -> None:
        """Write lambda, given the velocities ``moved`` of bodies without hinges by `move_kernels`."""
        for k, row in enumerate(self.rows):
            step.launch(self.kernels.read.forward, *self.known(k, row, moved), threads=self.layout.members)
        self.solve(step, self.own.whole["wanted"], self.own.whole["pushes"])

    def known(self, k: int, row: Row, moved: Sequence[Arrays]) -> tuple[Named, ...]:
        """Return the arguments of `read`."""
        numbers = {"share": row.share, "is_free": row.joint.other >= 0}
        return self.velocities(row, moved), self.own.rows[k], self.own.entries[k], numbers

    def velocities(self, row: Row, moved: Sequence[Arrays], suffix: str = "") -> Arrays:
        """Return the velocity changes of both bodies of a row, or tangents or adjoints, by argument names of `read`."""
        own = moved[row.joint.body]
        other = own if row.joint.other < 0 else moved[row.joint.other]
        names = [f"{name}{suffix}" for name in ("faster", "turned_faster")]
        return {name: own[name] for name in names} | {f"other_{name}": other[name] for name in names}

    def ends(self) -> Iterator[tuple[int, int, bool, Named]]:
        """Yield row number, body number, whether the body is the hinge's second solid, and arguments of `push`."""
        for k, row in enumerate(self.rows):
            for body, other in row.sides:
                yield k, body, other, {"share": row.share, "sign": -1.0 if other else 1.0}

    def push(self, step: StepContext, moved: Sequence[Arrays]) -> None:
        for k, body, other, known in self.ends():
            arrays = self.own.side(k, other), self.own.entries[k], moved[body]
            own = self.part.bodies[body].known(step)
            step.launch(self.kernels.push.forward, *arrays, known, *own, threads=self.layout.members)

    def join(self, step: StepContext, moved: Sequence[Arrays]) -> None:
        """Replace velocities of bodies without hinges by velocities that satisfy the hinges."""
        self.read(step, moved)
        self.push(step, moved)


class JointsTangent:
    def __init__(self, joints: Joints):
        self._joints, self._dots = joints, JointArrays(len(joints.rows), joints.layout, "_dot")

    def begin(self, step: StepContext, dot: Tangents) -> None:
        of, dots, members = self._joints, self._dots, self._joints.layout.members
        dots.whole["blocks_dot"].zero_()
        for k, row in enumerate(of.rows):
            place = f"{row.joint.name}.position"
            rates = {"place_dot": dot.parameters[place], "time_step_dot": dot.parameters["time_step"]}
            known = of.own.rows[k], {"place": step.parameters[place]}, *of.poses(row)
            step.launch(of.frame(row).tangent, dots.rows[k], rates, *known, threads=members)
        for pair in of.pairs:
            body = of.part.bodies[pair.body]
            rates = {"density_dot": dot.parameters[body.table.weight]}
            known = of.sides(of.own, pair), of.coefficients(pair), of.own.blocks[pair.block], *body.known(step)
            changes = of.sides(dots, pair), dots.blocks[pair.block], rates
            step.launch(of.kernels.weigh.tangent, *changes, *known, threads=members)

    def join(self, step: StepContext, dot: Tangents, moved: Sequence[Arrays], moved_dot: Sequence[Arrays]) -> None:
        """Apply the tangent of `Joints.join`, which joins ``moved`` too."""
        of, dots, members = self._joints, self._dots, self._joints.layout.members
        of.read(step, moved)
        for k, row in enumerate(of.rows):
            changes = of.velocities(row, moved_dot, "_dot"), dots.rows[k], dots.entries[k]
            step.launch(of.kernels.read.tangent, *changes, *of.known(k, row, moved), threads=members)
        if of.rows:
            step.launch(of.kernels.lengthen, of.own.whole, dots.whole, rows=len(of.rows), threads=members)
        of.solve(step, dots.whole["wanted_dot"], dots.whole["pushes_dot"])
        for k, body, far, signs in of.ends():
            own = of.part.bodies[body]
            rates = {"density_dot": dot.parameters[own.table.weight]}
            pushed = dots.side(k, far), dots.entries[k], moved_dot[body], rates
            arrays = of.own.side(k, far), of.own.entries[k], moved[body], signs, *own.known(step)
            step.launch(of.kernels.push.tangent, *pushed, *arrays, threads=members)
        of.push(step, moved)


class JointsAdjoint:
    def __init__(self, joints: Joints):
        self._joints, self._bars = joints, JointArrays(len(joints.rows), joints.layout, "_bar")
        names, members = [f"{way}{name}" for way in ("", "other_") for name in BARS], joints.layout.members
        self._poses = zeros(dict.fromkeys(names, (members, joints.layout.precision.vector)), joints.layout.device)

    def begin(self) -> None:
        self._bars.clear()

    def join(
        self,
        step: StepContext,
        bar: Adjoints,
        moved: Sequence[Arrays],
        moved_bar: Sequence[Arrays],
        turned: Sequence[Arrays],
    ) -> None:
        """Apply the adjoint of `Joints.join`: turn adjoints of joined velocities into those of the velocities ``moved``
        and of each body's turn."""
        of, bars, members = self._joints, self._bars, self._joints.layout.members
        of.read(step, moved)
        bars.whole["pushes_bar"].zero_()
        for k, body, far, signs in of.ends():
            own = of.part.bodies[body]
            rates = {"density_bar": bar.parameters[own.table.weight]}
            pushed = bars.side(k, far), bars.entries[k], moved_bar[body], turned[body], rates
            arrays = of.own.side(k, far), of.own.entries[k], moved[body], signs, *own.known(step)
            step.launch(of.kernels.push.adjoint, *pushed, *arrays, threads=members)
        of.solve(step, bars.whole["pushes_bar"], bars.whole["wanted_bar"], transposed=1)
        for k, row in enumerate(of.rows):
            changes = of.velocities(row, moved_bar, "_bar"), bars.rows[k], bars.entries[k]
            step.launch(of.kernels.read.adjoint, *changes, *of.known(k, row, moved), threads=members)
        if of.rows:
            step.launch(of.kernels.spread, of.own.whole, bars.whole, rows=len(of.rows), threads=members)

    def finish(self, step: StepContext, bar: Adjoints, turned: Sequence[Arrays]) -> None:
        of, bars, members = self._joints, self._bars, self._joints.layout.members
        for pair in of.pairs:
            body = of.part.bodies[pair.body]
            rates = {"density_bar": bar.parameters[body.table.weight]}
            known = of.sides(of.own, pair), of.coefficients(pair), of.own.blocks[pair.block], *body.known(step)
            changes = of.sides(bars, pair), bars.blocks[pair.block], rates, turned[pair.body]
            step.launch(of.kernels.weigh.adjoint, *changes, *known, threads=members)
        for k, row in enumerate(of.rows):
            place = f"{row.joint.name}.position"
            rates = {"place_bar": bar.parameters[place], "time_step_bar": bar.parameters["time_step"]}
            known = of.own.rows[k], {"place": step.parameters[place]}, *of.poses(row)
            for array in self._poses.values():
                array.zero_()
            step.launch(of.frame(row).adjoint, bars.rows[k], rates, self._poses, *known, threads=members)
            for way, number in (("", of.number(row)), ("other_", row.joint.against)):
                bar.solids.add_whole(number, **{name: self._poses[f"{way}{name}"] for name in BARS})
