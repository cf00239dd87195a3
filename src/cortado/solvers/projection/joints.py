"""Hinges in a step of the projection, with derivatives; see `cortado.solvers.projection.joint_kernels`."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.launching import Named
from cortado.particles.state import Layout, clear, zeros
from cortado.scene.links import Joint
from cortado.solvers.projection.joint_kernels import ROW, joint_kernels
from cortado.sph.free_solids import FreeSolidsPart
from cortado.sph.parts import Adjoints, StepContext, Tangents

Arrays = dict[str, wp.array]
GUARD = {"float32": 1e-5, "float64": 1e-10}
"""Regularisation of the matrix of hinges, relative to the trace of each diagonal block."""
BARS = ("turned_before_bar", "after_bar", "turned_bar")


@dataclass(frozen=True)
class Pair:
    """Two equations that contain the same body: the row and the column of a matrix block."""

    block: tuple[int, int]
    body: int
    far: tuple[bool, bool]
    """Flags of the matrix block's row and column: True if the body is the second solid of the hinge."""


class JointArrays:
    """Arrays of the hinges in a step. ``suffix`` selects tangents or adjoints."""

    def __init__(self, rows: int, layout: Layout, suffix: str = ""):
        matrix, vector, self._suffix = layout.precision.matrix, layout.precision.vector, suffix
        kinds = {**dict.fromkeys(ROW, matrix), "apart": vector}
        sizes = {f"{name}{suffix}": (layout.members, kind) for name, kind in kinds.items()}
        self.rows = [zeros(sizes, layout.device) for _ in range(rows)]
        many = {"blocks": (rows * rows, matrix), "wanted": (rows, vector), "pushes": (rows, vector)}
        sizes = {f"{name}{suffix}": ((count, layout.members), kind) for name, (count, kind) in many.items()}
        self.whole = zeros(sizes, layout.device)
        blocks, wanted, pushes = self.whole.values()
        self.entries = [{f"wanted{suffix}": wanted[k], f"push{suffix}": pushes[k]} for k in range(rows)]
        self.blocks = {(k, n): {f"block{suffix}": blocks[k * rows + n]} for k in range(rows) for n in range(rows)}

    def side(self, k: int, other: bool) -> Arrays:
        """Return matrices ``give`` and ``take`` of equation ``k``, for the hinge's second solid if ``other``."""
        way = "other_" if other else ""
        return {f"{name}{self._suffix}": self.rows[k][f"{way}{name}{self._suffix}"] for name in ("give", "take")}

    def sides(self, pair: Pair) -> Arrays:
        give, take = f"give{self._suffix}", f"take{self._suffix}"
        row, column = (self.side(k, far) for k, far in zip(pair.block, pair.far, strict=True))
        return {take: row[take], give: column[give]}


@dataclass(frozen=True)
class Row:
    """A vector equation of a hinge."""

    joint: Joint
    share: float
    """Number that is 1 for the equation of the hinge's point, and 0 for the equation of the hinge's axis."""

    @property
    def place(self) -> str:
        return f"{self.joint.name}.position"

    @property
    def sides(self) -> list[tuple[int, bool]]:
        """Return the number of each free body in the equation, and True if the body is the hinge's second solid."""
        return [(body, other) for body, other in ((self.joint.body, False), (self.joint.other, True)) if body >= 0]


class Joints:
    def __init__(self, part: FreeSolidsPart, joints: Sequence[Joint], layout: Layout):
        self.part, self.layout = part, layout
        self.rows = []
        for joint in joints:
            has_axis = part.made_of.dimension == 3 and joint.axis is not None
            self.rows += [Row(joint, share) for share in ((1.0, 0.0) if has_axis else (1.0,))]
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
        return joint_kernels(self.layout.precision)

    def number(self, row: Row) -> int:
        return self.part.bodies[row.joint.body].table.number

    def weight(self, body: int) -> str:
        return self.part.bodies[body].table.weight

    def frames(self, step: StepContext) -> Iterator[tuple[int, Row, Any, tuple[Named, ...]]]:
        """Yield the number of each equation, the equation, and the kernels and arguments of the equation."""
        vector, each = self.layout.precision.vector, self.part.made_of.walls.each
        for k, row in enumerate(self.rows):
            joint = row.joint
            named = {**each[self.number(row)], **{f"other_{name}": a for name, a in each[joint.against].items()}}
            known: dict[str, Any] = {} if joint.axis is None else {"axis": vector(*joint.axis)}
            for way, begun in zip(("", "other_"), joint.begun, strict=True):
                known[f"{way}middle"] = vector(*begun.middle)
                known[f"{way}begun"] = self.layout.precision.matrix(*begun.turn.ravel())
            known["place"] = step.parameters[row.place]
            yield k, row, self.kernels.point if row.share else self.kernels.lean, (self.own.rows[k], known, named)

    def weighed(self, step: StepContext) -> Iterator[tuple[Pair, tuple[Named, ...]]]:
        for pair in self.pairs:
            row, column = (self.rows[k] for k in pair.block)
            own = {"row_share": row.share, "share": column.share, "sign": 1.0 if pair.far[0] == pair.far[1] else -1.0}
            guard = GUARD[self.layout.precision.name]
            own |= {"guard": guard, "along": 1.0 - row.share} if row is column else {"guard": 0.0, "along": 0.0}
            body = self.part.bodies[pair.body].known(step)
            yield pair, (self.own.sides(pair), own, self.own.blocks[pair.block], *body)

    def read(self, moved: Sequence[Arrays]) -> Iterator[tuple[int, Row, tuple[Named, ...]]]:
        for k, row in enumerate(self.rows):
            numbers = {"share": row.share, "is_free": row.joint.other >= 0}
            yield k, row, (velocities(row, moved), self.own.rows[k], self.own.entries[k], numbers)

    def ends(self, step: StepContext, moved: Sequence[Arrays]) -> Iterator[tuple[int, int, bool, tuple[Named, ...]]]:
        """Yield equation number, body number, True for the second solid of the hinge, and arguments of ``push``."""
        for k, row in enumerate(self.rows):
            for body, other in row.sides:
                signs, own = {"share": row.share, "sign": -1.0 if other else 1.0}, self.part.bodies[body].known(step)
                yield k, body, other, (self.own.side(k, other), self.own.entries[k], moved[body], signs, *own)

    def begin(self, step: StepContext) -> None:
        self.own.whole["blocks"].zero_()
        for _, _, kernels, known in self.frames(step):
            step.launch(kernels.forward, *known, threads=self.layout.members)
        for _, known in self.weighed(step):
            step.launch(self.kernels.weigh.forward, *known, threads=self.layout.members)
        if self.rows:
            factors = self.own.whole, self.factors
            step.launch(self.kernels.factor, *factors, rows=len(self.rows), threads=self.layout.members)

    def solve(self, step: StepContext, wanted: wp.array, pushes: wp.array, transposed: int = 0) -> None:
        """``transposed`` 1 selects the transposed system."""
        known = {"rows": len(self.rows), "transposed": transposed, "wanted": wanted, "pushes": pushes}
        if self.rows:
            step.launch(self.kernels.solve, self.factors, known, threads=self.layout.members)

    def find(self, step: StepContext, moved: Sequence[Arrays]) -> None:
        """``moved`` are the velocities of bodies without hinges."""
        for _, _, known in self.read(moved):
            step.launch(self.kernels.read.forward, *known, threads=self.layout.members)
        self.solve(step, self.own.whole["wanted"], self.own.whole["pushes"])

    def push(self, step: StepContext, moved: Sequence[Arrays]) -> None:
        for *_, known in self.ends(step, moved):
            step.launch(self.kernels.push.forward, *known, threads=self.layout.members)

    def join(self, step: StepContext, moved: Sequence[Arrays]) -> None:
        """Replace velocities of bodies without hinges by velocities with hinges."""
        self.find(step, moved)
        self.push(step, moved)


def velocities(row: Row, moved: Sequence[Arrays], suffix: str = "") -> Arrays:
    own = moved[row.joint.body]
    other = own if row.joint.other < 0 else moved[row.joint.other]
    names = [f"{name}{suffix}" for name in ("faster", "turned_faster")]
    return {name: own[name] for name in names} | {f"other_{name}": other[name] for name in names}


class JointsTangent:
    def __init__(self, joints: Joints, dot: Tangents):
        self._joints, self._dot = joints, dot.parameters
        self._dots = JointArrays(len(joints.rows), joints.layout, "_dot")

    def begin(self, step: StepContext) -> None:
        of, dots, members = self._joints, self._dots, self._joints.layout.members
        dots.whole["blocks_dot"].zero_()
        for k, row, kernels, known in of.frames(step):
            rates = {"place_dot": self._dot[row.place], "time_step_dot": self._dot["time_step"]}
            step.launch(kernels.tangent, dots.rows[k], rates, *known, threads=members)
        for pair, known in of.weighed(step):
            changes = dots.sides(pair), dots.blocks[pair.block], {"density_dot": self._dot[of.weight(pair.body)]}
            step.launch(of.kernels.weigh.tangent, *changes, *known, threads=members)

    def join(self, step: StepContext, moved: Sequence[Arrays], moved_dot: Sequence[Arrays]) -> None:
        """Apply the tangent of `Joints.join`, and update ``moved``."""
        of, dots, members = self._joints, self._dots, self._joints.layout.members
        of.find(step, moved)
        for k, row, known in of.read(moved):
            changes = velocities(row, moved_dot, "_dot"), dots.rows[k], dots.entries[k]
            step.launch(of.kernels.read.tangent, *changes, *known, threads=members)
        if of.rows:
            step.launch(of.kernels.lengthen, of.own.whole, dots.whole, rows=len(of.rows), threads=members)
        of.solve(step, dots.whole["wanted_dot"], dots.whole["pushes_dot"])
        for k, body, far, known in of.ends(step, moved):
            pushed = dots.side(k, far), dots.entries[k], moved_dot[body], {"density_dot": self._dot[of.weight(body)]}
            step.launch(of.kernels.push.tangent, *pushed, *known, threads=members)
        of.push(step, moved)


class JointsAdjoint:
    def __init__(self, joints: Joints, bar: Adjoints, turned: Sequence[Arrays]):
        self._joints, self._bar, self._turned = joints, bar, turned
        self._bars = JointArrays(len(joints.rows), joints.layout, "_bar")
        names, members = [f"{way}{name}" for way in ("", "other_") for name in BARS], joints.layout.members
        self._poses = zeros(dict.fromkeys(names, (members, joints.layout.precision.vector)), joints.layout.device)

    def begin(self) -> None:
        for group in (*self._bars.rows, self._bars.whole):
            clear(group.values())

    def join(self, step: StepContext, moved: Sequence[Arrays], moved_bar: Sequence[Arrays]) -> None:
        """Apply the adjoint of `Joints.join` to the adjoints of velocities, ``moved_bar``."""
        of, bars, members = self._joints, self._bars, self._joints.layout.members
        of.find(step, moved)
        bars.whole["pushes_bar"].zero_()
        for k, body, far, known in of.ends(step, moved):
            rates = {**self._turned[body], "density_bar": self._bar.parameters[of.weight(body)]}
            pushed = bars.side(k, far), bars.entries[k], moved_bar[body], rates
            step.launch(of.kernels.push.adjoint, *pushed, *known, threads=members)
        of.solve(step, bars.whole["pushes_bar"], bars.whole["wanted_bar"], transposed=1)
        for k, row, known in of.read(moved):
            changes = velocities(row, moved_bar, "_bar"), bars.rows[k], bars.entries[k]
            step.launch(of.kernels.read.adjoint, *changes, *known, threads=members)
        if of.rows:
            step.launch(of.kernels.spread, of.own.whole, bars.whole, rows=len(of.rows), threads=members)

    def finish(self, step: StepContext) -> None:
        of, bars, bar, members = self._joints, self._bars, self._bar, self._joints.layout.members
        for pair, known in of.weighed(step):
            rates = {**self._turned[pair.body], "density_bar": bar.parameters[of.weight(pair.body)]}
            changes = bars.sides(pair), bars.blocks[pair.block], rates
            step.launch(of.kernels.weigh.adjoint, *changes, *known, threads=members)
        for k, row, kernels, known in of.frames(step):
            rates = {"place_bar": bar.parameters[row.place], "time_step_bar": bar.parameters["time_step"]}
            clear(self._poses.values())
            step.launch(kernels.adjoint, bars.rows[k], rates, self._poses, *known, threads=members)
            for way, number in (("", of.number(row)), ("other_", row.joint.against)):
                bar.solids.add_whole(number, **{name: self._poses[f"{way}{name}"] for name in BARS})
