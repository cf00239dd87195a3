"""What sums over walls give to the adjoints of where solids that move are, and of how large.

For a sum S_i = sum_b w_b T(x_ib, foot_b, v_b, ...) over wall particles and an adjoint of each S_i, particle i gives,
with W = T . S_i^, to wall particle b

    x_b^ = -w_b dW / dx_ib,   foot_b^ = w_b dW / dfoot_b,   v_b^ = w_b dW / dv_b,

made by Warp from W. The point of the surface above it is s_b = c + R q_b, and it is at x_b = s_b - foot_b, with a foot
that R has turned too. Its velocity is that of s_b, which is (s_b - s_b^0) / dt + R u from s_b^0 = c_0 + R_0 q_b at the
start of the step. A scale sigma has made q_b so many times as long, and w_b sigma^(d - 1) times as large. A solid moves
by c', turns further by w', and grows by g' = sigma' / sigma, and its pose at the start of the step changed by c_0' and
w_0'. So it has the work f . c' + t . w' + f_0 . c_0' + t_0 . w_0' + g g' with

    f = sum x_b^ + v_b^ / dt,    t = sum (x_b - c) x x_b^ + R q_b x v_b^ / dt + foot_b x foot_b^ + R u x v_b^,
    f_0 = -sum v_b^ / dt,        t_0 = -sum R_0 q_b x v_b^ / dt,
    g = sum R q_b . x_b^ + (R q_b - R_0 q_b) . v_b^ / dt + (d - 1) w_b W.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import warp as wp

from cortado.device.launching import Named, bundle
from cortado.device.precision import Precision
from cortado.device.reduction import add
from cortado.particles.moving_walls import MovingWalls, matrix_of
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.particles.pair_sums import scope_of
from cortado.particles.state import Layout
from cortado.particles.terms import Term

ALL_WALLS = -(2**31)
"""In the place of the number of a solid: those of all solids and of the container."""
NAMES = ("force", "torque", "force_before", "torque_before", "growth")
"""f, t, f_0, t_0 and g."""
WHOLE = ("force", "torque", "growth")
"""What others than particles give."""
SUM = """\
def {name}(
    i: int, x: _vectors, at: _seen, constants: _pair, solid: int, middle: _vector, back: _matrix, slide: _vector,
    power: _real, s: _neighbourhood,
):
    _x_i = x[i]
{own}
    _force = _vector()
    _torque = _vector()
    _pulled = _vector()
    _twisted = _vector()
    _twisted_before = _vector()
    _rate = _real(0.0)
    _grown = _real(0.0)
    _spread = _real(0.0)
    for _place in range(s.fluid_count[i], s.count[i]):
        _b = _neighbour(_place, i, s)
        if _wall_solid(_b, s) == solid:
            _w_b = {weight}(_b, s)
            _x_b = _wall_position(_b, s)
            _v_b = _wall_velocity(_b, s)
            _foot = _wall_foot(_b, s)
            _x_ij = _separation(_x_i, _x_b, s)
            {gradients} = _wp.grad(_work)({arguments})
            _arm = _x_b - middle
            _x_bar = -_w_b * _by_x_ij
            _v_bar = {by_v}
            _force += _x_bar
            _torque += _wp.cross(_arm, _x_bar){by_foot}
            _pulled += _v_bar
            _surface = _arm + _foot
            _surface_before = back * _surface
            _twisted += _wp.cross(_surface, _v_bar)
            _twisted_before += _wp.cross(_surface_before, _v_bar)
            _rate += _wp.dot(_v_bar, _v_b - slide)
            _grown += _wp.dot(_surface, _x_bar) + power * _w_b * _work({arguments})
            _spread += _wp.dot(_surface - _surface_before, _v_bar)
    return _force, _torque, _pulled, _twisted, _twisted_before, _rate, _grown, _spread
"""


class SolidShares:
    """What the particles give to the adjoints of the poses of solids in one step, particle by particle."""

    def __init__(self, walls: MovingWalls | None, layout: Layout):
        """``walls`` of the solids; where None move, nothing is given."""
        self._walls, self._pair = walls, layout.precision.pair
        size, kinds, device = layout.all_particles, share_kinds(layout.precision), layout.device
        solids = range(0 if walls is None else walls.solids)
        self._arrays = [{name: wp.zeros(size, dtype=kinds[name], device=device) for name in NAMES} for _ in solids]
        self._sums = [{name: layout.sum_of(kinds[name]) for name in NAMES} for _ in solids]
        self._whole = [
            {name: wp.zeros(layout.members, dtype=kinds[name], device=device) for name in WHOLE} for _ in solids
        ]
        """What was given by others than particles."""

    def add(
        self,
        launch: Callable[..., None],
        kernel: Callable[[], Any],
        *groups: Named,
        constants: tuple[float, float] = (0.0, 0.0),
        over: int = ALL_WALLS,
        **arrays: Any,
    ) -> None:
        """What a sum gives, by the kernel that `solid_kernel` makes of it, which is asked for where solids move; of a
        sum ``over`` the walls of one solid, to that alone."""
        if self._walls is None:
            return
        before, after, power = self._walls.before, self._walls.after, self._walls.sizes.power
        poses = {"positions": after.positions, "turns": after.turns, "turns_before": before.turns, "power": power}
        known = {**poses, "slides": self._walls.slides, "constants": self._pair(*constants), "k": 0, "rounds": None}
        for solid in range(self._walls.solids):
            if over in (ALL_WALLS, solid):
                launch(kernel(), self.of(solid), *groups, known, solid=solid, **arrays)

    def of(self, solid: int) -> dict[str, wp.array]:
        """(n,) what the particles have given to one solid so far, as kernels call it."""
        return {f"{name}_bar": array for name, array in self._arrays[solid].items()}

    def collect(self, solid: int) -> dict[str, wp.array]:
        """The sums (members,) of one solid, by `NAMES`, and begin anew."""
        found = {name: total(self._arrays[solid][name]) for name, total in self._sums[solid].items()}
        for name, given in self._whole[solid].items():
            add(given, found[name])
        self._forget(solid)
        return found

    def add_whole(self, solid: int, *given: wp.array) -> None:
        """(members,) f, t, and g where there is one, which others than particles give to one solid."""
        for one, own in zip(given, self._whole[solid].values(), strict=False):
            add(one, own)

    def clear(self) -> None:
        """Forget what was given."""
        for solid in range(len(self._arrays)):
            self._forget(solid)

    def _forget(self, solid: int) -> None:
        for array in (*self._arrays[solid].values(), *self._whole[solid].values()):
            array.zero_()


def share_kinds(precision: Precision) -> dict[str, Any]:
    """Types of what a particle gives, by `NAMES`."""
    return {**dict.fromkeys(NAMES, precision.vector), "growth": precision.real}


WorkMaker = Callable[[Discretisation], Callable[..., Any]]


@cache
def solid_kernel(
    discretisation: Discretisation, topic: str, make: WorkMaker, rubs: bool = False, looped: bool = False
) -> Any:
    """The kernel of one sum, for `SolidShares.add`, in the Warp module of a ``topic``.

    ``make(discretisation)`` gives W, a term of walls (`cortado.particles.terms`) that returns a number, of functions
    that Warp can differentiate; it knows entries of arrays of particle i, ``v_ij`` or ``v_j``, and ``constants``. As
    those of walls, a sum that ``rubs`` has nothing of walls that slip freely. A ``looped`` one is of iteration k, and
    leaves out scenes that make fewer ``rounds``.
    """
    d = replace(discretisation, lanes=1, taped=True)
    precision, term = d.precision, Term.of(make(d))
    real, vector, matrix, pair = precision.real, precision.vector, matrix_of(precision), precision.pair
    seen = bundle(**{name: kind for name, kind in term.arrays.items() if name != "x"})
    module = replace(discretisation, lanes=1, taped=False).module(False, f"{topic}_{term.name}_solids")
    shares = _sum(term, d, seen, rubs, module)
    neighbourhood = neighbourhood_type(precision)
    bars = bundle(**share_kinds(precision), time_step=real)
    LOOPED = wp.constant(looped)

    def share(
        s: neighbourhood,
        k: int,
        rounds: wp.array(dtype=wp.int32),
        solid: int,
        constants: pair,
        time_step: wp.array(dtype=real),
        positions: wp.array2d(dtype=vector),
        turns: wp.array2d(dtype=matrix),
        turns_before: wp.array2d(dtype=matrix),
        slides: wp.array(dtype=vector),
        power: real,
        x: wp.array(dtype=vector),
        at: seen,
        # in and out
        bar: bars,
    ):
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
            i, x, at, constants, solid, positions[member, solid], back, slide, power, s
        )
        per = real(1.0) / time_step[member]
        bar.force[i] = bar.force[i] + force + per * pulled
        bar.torque[i] = bar.torque[i] + torque + per * twisted + wp.cross(slide, pulled)
        bar.force_before[i] = bar.force_before[i] - per * pulled
        bar.torque_before[i] = bar.torque_before[i] - per * twisted_before
        bar.growth[i] = bar.growth[i] + grown + per * spread
        bar.time_step[i] = bar.time_step[i] - per * rate

    share.__qualname__ = share.__name__ = f"{term.name}_share"
    return wp.kernel(share, module=module, enable_backward=False)


def _sum(term: Term, d: Discretisation, seen: Any, rubs: bool, module: Any) -> Any:
    """The Warp function of the sums over the wall particles of one solid."""
    precision = d.precision
    velocity = [name for name in ("v_ij", "v_j") if name in term.parameters]
    by_v = {(): "_vector()", ("v_ij",): "-_w_b * _by_v_ij", ("v_j",): "_w_b * _by_v_j"}[tuple(velocity)]
    read = {name for name in term.arrays if name != "x" and {f"{name}_i", f"{name}_ij"} & term.parameters.keys()}
    text = SUM.format(
        name=f"{term.name}_sum",
        own="\n".join(f"    _{name}_i = at.{name}[i]" for name in sorted(read)),
        weight="_wall_grip" if rubs else "_wall_weight",
        gradients=", ".join(f"_by_{name}" for name in term.parameters),
        arguments=term.seen_from_i({"v": "_v_b"}),
        by_v=by_v,
        by_foot=" + _wp.cross(_foot, _w_b * _by_foot)" if "foot" in term.parameters else "",
    )
    known: dict[str, Any] = {
        **scope_of(d),
        "_matrix": matrix_of(precision),
        "_pair": precision.pair,
        "_vectors": wp.array(dtype=precision.vector),
        "_seen": seen,
        "_wp": wp,
        "_work": wp.func(term.function, module=module),
    }
    exec(text, known)
    return wp.Function(known[f"{term.name}_sum"], f"{term.name}_sum", "", module=module, source=text)
