"""One term of a time step that acts on each particle from the walls of one solid or from all walls.

The derivatives of the term include derivatives with respect to the pose and size of moving solids. A term is defined by
its work W, a number that is linear in a vector ``bar`` of particle i. The sum over wall particles b, such as the
acceleration by walls, is

    A_i = sum_b w_b dW / dbar_i.

Warp differentiates W. Component k of the tangent of A is the change of w_b W for the k-th unit vector as ``bar``. For
the adjoint of the sum, ``bar`` is the adjoint of A. Particle i then adds to the adjoints of wall particle b

    x_b^ = -w_b dW / dx_ib,   foot_b^ = w_b dW / dfoot_b,   v_b^ = w_b dW / dv_b.

The nearest point on the surface is s_b = c + R q_b, with the middle c and the rotation R of the solid. The wall
particle is at x_b = s_b - foot_b, where foot_b is already rotated by R. The velocity of the wall particle is (s_b -
s_b^0) / dt + R u, where u is the velocity of the surface along the solid. At the start of the step the nearest point is
s_b^0 = c_0 + R_0 q_b. A scale sigma multiplies q_b by sigma, and w_b by sigma^(d - 1).

Let a solid move by c', turn further by w' and grow by g' = sigma' / sigma, and let its pose at the start of the step
change by c_0' and w_0'. The work is f^T c' + t^T w' + f_0^T c_0' + t_0^T w_0' + g g' with

    f = sum x_b^ + v_b^ / dt,    t = sum (x_b - c) x x_b^ + R q_b x v_b^ / dt + foot_b x foot_b^ + R u x v_b^,
    f_0 = -sum v_b^ / dt,        t_0 = -sum R_0 q_b x v_b^ / dt,
    g = sum R q_b . x_b^ + (R q_b - R_0 q_b) . v_b^ / dt + (d - 1) w_b W.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import warp as wp

from cortado.device.launching import Named, bundle
from cortado.device.modules import Kernels
from cortado.device.precision import Precision, TypesByName
from cortado.device.reduction import add
from cortado.particles.made_derivatives import dot_of
from cortado.particles.mirrors import ALL_WALLS
from cortado.particles.moving_walls import MovingWalls
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.particles.pair_sums import ALL, FOOT, GROWTH, MOVING, PLACE, RUBBING, TURN, Term, scope_of
from cortado.particles.particle_kernels import MADE, made_kernel
from cortado.particles.state import Layout, clear, zeros

NAMES = ("force", "torque", "force_before", "torque_before", "growth")
BARS = [f"{name}_bar" for name in ("after", "turned", "before", "turned_before", "scales")]
LOOP = """\
_x_i = at.x[i]
    _mirrors = _mirror_of(_x_i, i // s.particles, s)
    {own}
    for _place in range(s.fluid_count[i], s.count[i]):
        _b = _neighbour(_place, i, s)
        if solid == _ALL or s.wall_solids[_b] == solid:
            _w_b = {weight}
            _x_b = {place}
            _v_b = {velocity}
            _foot = {foot}
            _x_ij = _separation(_x_i, _x_b, s)
            _mirrored = wp.where(_mirrors_in(_b, _mirrors, s), _real(1.0), _real(0.0))
            {body}"""
SHARE = """\
def {name}(
    i: int, at: _seen, constants: _pair, solid: int, middle: _vector, back: _matrix, slide: _vector, power: _real,
    s: _neighbourhood,
):
    {loop}
    return _force, _torque, _pulled, _twisted, _twisted_before, _rate, _grown, _spread
"""

Call = Callable[..., Any]
WorkMaker = Callable[[Discretisation], Call]
Pair = tuple[float, float]


@dataclass(frozen=True)
class _Loop:
    term: Term
    d: Discretisation
    rubs: bool

    @property
    def read(self) -> list[str]:
        parameters = self.term.parameters
        return [name for name in self.term.arrays if name != "x" and {f"{name}_i", f"{name}_ij"} & parameters.keys()]

    @property
    def arguments(self) -> str:
        return self.term.seen_from_i({"v": "_v_b"})

    @property
    def gradients(self) -> str:
        return f"{', '.join(f'_by_{name}' for name in self.term.parameters)} = wp.grad(_work)({self.arguments})"

    def text(self, given: Iterable[str], own: Iterable[str], body: Iterable[str]) -> str:
        entries = [f"_{name}_i = at.{name}[i]" for name in self.read if name not in given]
        return LOOP.format(
            own="\n    ".join((*entries, *own)),
            **{"weight": RUBBING if self.rubs else ALL, "place": PLACE, "velocity": MOVING["v"], "foot": FOOT},
            body="\n            ".join(body),
        )

    def known(self, module: Any) -> dict[str, Any]:
        types = {"_matrix": self.d.precision.matrix, "_pair": self.d.precision.pair}
        work = wp.func(self.term.function, module=module)
        return {**scope_of(self.d), **types, "_ALL": wp.constant(ALL_WALLS), "_work": work, "wp": wp}


@dataclass(frozen=True)
class WallTerm:
    """``make(discretisation)`` returns the function that computes the work of the term."""

    discretisation: Discretisation
    topic: str
    make: WorkMaker
    bar: str
    rubs: bool = False

    @property
    def kernels(self) -> Kernels:
        """The kernel argument ``solid`` is the number of a solid or `ALL_WALLS`."""
        return _kernels(self)

    def solid_kernel(self) -> Any:
        """Return the kernel that computes the adjoints of a moving solid's pose and scale."""
        return solid_kernel(self.discretisation, self.topic, self.make, self.rubs)


@cache
def _kernels(of: WallTerm) -> Kernels:
    d = replace(of.discretisation, lanes=1, taped=True)
    precision, term = d.precision, Term.of(of.make(d))
    real, vector, zero = precision.real, precision.vector, "_vector()"
    loop = _Loop(term, d, of.rubs)
    kinds = {"x": vector, **{name: term.arrays[name] for name in loop.read if name != of.bar}}
    seen, bar = bundle(**kinds), f"_{of.bar}_i"
    modules = replace(d, taped=False).modules(f"{of.topic}_{term.name}_walls")
    one = {"s": neighbourhood_type(precision), "solid": int, "constants": precision.pair, "at": seen}

    def made(way: int, types: dict[str, Any], own: list[str], body: list[str], end: Iterable[str]) -> Any:
        lines = ["i = s.first + wp.tid()", loop.text([of.bar], own, body), *end]
        name = f"{MADE}{term.name}_act{('', '_tangent', '_adjoint')[way]}"
        return made_kernel(name, {**one, **types}, lines, loop.known(modules[way]), modules[way])

    dots = {name: f"_{name}_i_dot" for name in kinds}
    changes = {
        "x_ij": f"{dots['x']} - {MOVING['x_dot'] if d.moving else zero}",
        "v_ij": f"{dots.get('v')} - {MOVING['v_dot'] if d.moving else zero}",
        "foot": f"wp.cross({TURN if d.moving else zero}, _foot)",
        **{f"{name}_i": dots[name] for name in kinds if name != "x"},
    }
    moved = {name: kind for name, kind in term.parameters.items() if name in changes}
    terms = [
        f"_by_{name} * _change_{name}" if kind is real else f"wp.{dot_of(kind)}(_by_{name}, _change_{name})"
        for name, kind in moved.items()
    ]
    if d.moving:  # W is linear in the unit vector, of which its gradient is all that the wall does
        terms.append(f"{GROWTH} * _by_{of.bar}_i[_k]")
    along = [
        *(f"_change_{name} = {changes[name]}" for name in moved),
        "for _k in range(_three):",
        f"    {bar} = _vector()",
        f"    {bar}[_k] = _real(1.0)",
        f"    {loop.gradients}",
        f"    _total[_k] += _w_b * ({' + '.join(terms)})",
    ]
    start = [*(f"{dot} = dot.{name}[i]" for name, dot in dots.items()), "_total = _vector()"]
    start.append("_three = int(3)")  # not a number: Warp would write the gradient out for each
    by = {name: next(f"_by_{p}" for p in (f"{name}_i", f"{name}_ij") if p in term.parameters) for name in kinds}
    zeros = {real: "_real(0.0)", vector: zero}
    total = wp.array(dtype=vector)
    first = [f"{bar} = total_bar.{of.bar}[i]"]
    first += [f"_{name}_sum = {zeros.get(kind, '_matrix()')}" for name, kind in kinds.items()]
    back = [loop.gradients, *(f"_{name}_sum += _w_b * {one}" for name, one in by.items())]
    stored = [f"bar.{name}[i] = bar.{name}[i] + _{name}_sum" for name in kinds]
    act = [loop.gradients, f"_total += _w_b * _by_{of.bar}_i"]
    return Kernels(
        made(0, {"total": total}, [f"{bar} = _vector()", "_total = _vector()"], act, ["total[i] = _total"]),
        made(1, {"dot": seen, "total_dot": total}, start, along, ["total_dot[i] = _total"]),
        made(2, {"total_bar": bundle(**{of.bar: vector}), "bar": seen}, first, back, stored),
    )


class SolidShares:
    """The contributions of particles to the adjoints of the poses of solids in a time step."""

    def __init__(self, walls: MovingWalls | None, layout: Layout):
        self._walls, self._pair = walls, layout.precision.pair
        kinds, solids = share_kinds(layout.precision), range(0 if walls is None else walls.solids)
        self._arrays = [layout.arrays("_bar", **kinds) for _ in solids]
        self._sums = [[layout.sum_of(kind) for kind in kinds.values()] for _ in solids]
        whole = {bar: (layout.members, kind) for bar, kind in zip(BARS, kinds.values(), strict=True)}
        self._whole = [zeros(whole, layout.device) for _ in solids]

    def add(
        self, launch: Call, kernel: Call, *groups: Named, constants: Pair = (0.0, 0.0), over: int = ALL_WALLS, **at: Any
    ) -> None:
        """Add the contributions of a sum ``over`` one solid or all walls. ``kernel()`` makes the kernel."""
        if self._walls is None:
            return
        own = {"power": self._walls.sizes.power, "slides": self._walls.slides, "constants": self._pair(*constants)}
        known = {**self._walls.named, **own, "k": 0, "rounds": None}
        for solid in range(self._walls.solids):
            if over in (ALL_WALLS, solid):
                launch(kernel(), self.of(solid), *groups, known, solid=solid, **at)

    def of(self, solid: int) -> dict[str, wp.array]:
        return self._arrays[solid]

    def collect(self, solid: int) -> dict[str, wp.array]:
        """Return adjoints (members,) of a solid's pose and scale, and reset the contributions to 0."""
        sums = zip(self._sums[solid], self._arrays[solid].values(), strict=True)
        found = dict(zip(BARS, (total(array) for total, array in sums), strict=True))
        for bar, given in self._whole[solid].items():
            add(given, found[bar])
        clear((*self._arrays[solid].values(), *self._whole[solid].values()))
        return found

    def add_whole(self, solid: int, **given: wp.array) -> None:
        """Add values (members,) to the adjoints of a solid. `BARS` has the names of the values."""
        for bar, one in given.items():
            add(one, self._whole[solid][bar])

    def clear(self) -> None:
        for group in (*self._arrays, *self._whole):
            clear(group.values())


def share_kinds(precision: Precision) -> dict[str, Any]:
    return {**dict.fromkeys(NAMES, precision.vector), "growth": precision.real}


@cache
def solid_kernel(
    discretisation: Discretisation, topic: str, make: WorkMaker, rubs: bool = False, looped: bool = False
) -> Any:
    """``make(discretisation)`` returns the function that computes the work of a wall term. The function of the work may
    call only functions that Warp can differentiate."""
    d = replace(discretisation, lanes=1, taped=True)
    precision, term = d.precision, Term.of(make(d))
    real, vector, matrix, pair = precision.real, precision.vector, precision.matrix, precision.pair
    seen, module = bundle(**term.arrays), replace(d, taped=False).module(False, f"{topic}_{term.name}_solids")
    shares = _share(_Loop(term, d, rubs), seen, module)
    neighbourhood = neighbourhood_type(precision)
    bars = bundle(**share_kinds(precision), time_step=real)
    LOOPED = wp.constant(looped)

    poses = {wp.array2d(dtype=vector): "after", wp.array2d(dtype=matrix): "turns", wp.array2d(dtype=real): "scales"}
    typed = TypesByName(
        real, {neighbourhood: "s", wp.int32: "rounds", vector: "slides", seen: "at", bars: "bar", **poses}
    )

    @typed.arrays
    def share(
        s, k: int, rounds, solid: int, constants: pair, time_step, after, turns, turns_before, scales, slides,
        power: real, at, bar,
    ):  # fmt: skip
        i = s.first + wp.tid()
        member = i // s.particles
        if s.count[i] <= s.fluid_count[i]:
            return
        if LOOPED:  # noqa: SIM102, as Warp reads both sides of an `and`
            if k >= rounds[member]:
                return
        R = turns[member, solid]
        slide = R * slides[solid]
        back = turns_before[member, solid] * wp.transpose(R)
        force, torque, pulled, twisted, twisted_before, rate, grown, spread = shares(
            i, at, constants, solid, after[member, solid], back, slide, power, s
        )
        per = real(1.0) / time_step[member]
        bar.force[i] = bar.force[i] + force + per * pulled
        bar.torque[i] = bar.torque[i] + torque + per * twisted + wp.cross(slide, pulled)
        bar.force_before[i] = bar.force_before[i] - per * pulled
        bar.torque_before[i] = bar.torque_before[i] - per * twisted_before
        bar.growth[i] = bar.growth[i] + (grown + per * spread) / scales[member, solid]
        bar.time_step[i] = bar.time_step[i] - per * rate

    share.__qualname__ = share.__name__ = f"{term.name}_share"
    return wp.kernel(share, module=module, enable_backward=False)


def _share(loop: _Loop, seen: Any, module: Any) -> Any:
    term = loop.term
    velocity = [name for name in ("v_ij", "v_j") if name in term.parameters]
    by_v = {(): "_vector()", ("v_ij",): "-_w_b * _by_v_ij", ("v_j",): "_w_b * _by_v_j"}[tuple(velocity)]
    by_foot = " + wp.cross(_foot, _w_b * _by_foot)" * ("foot" in term.parameters)
    body = [
        loop.gradients,
        "_arm = _x_b - middle",
        "_x_bar = -_w_b * _by_x_ij",
        f"_v_bar = {by_v}",
        "_force += _x_bar",
        f"_torque += wp.cross(_arm, _x_bar){by_foot}",
        "_pulled += _v_bar",
        "_surface = _arm + _foot",
        "_surface_before = back * _surface",
        "_twisted += wp.cross(_surface, _v_bar)",
        "_twisted_before += wp.cross(_surface_before, _v_bar)",
        "_rate += wp.dot(_v_bar, _v_b - slide)",
        f"_grown += wp.dot(_surface, _x_bar) + power * _w_b * _work({loop.arguments})",
        "_spread += wp.dot(_surface - _surface_before, _v_bar)",
    ]
    own = [f"_{name} = _vector()" for name in ("force", "torque", "pulled", "twisted", "twisted_before")]
    own += [f"_{name} = _real(0.0)" for name in ("rate", "grown", "spread")]
    text = SHARE.format(name=f"{term.name}_sum", loop=loop.text([], own, body))
    known = {**loop.known(module), "_seen": seen}
    exec(text, known)
    return wp.Function(known[f"{term.name}_sum"], f"{term.name}_sum", "", module=module, source=text)
