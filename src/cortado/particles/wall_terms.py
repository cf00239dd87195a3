"""What the walls of one solid, or all walls, do to each particle by one term of a step, with its derivatives.

A term is told by its work W, a number that is linear in a vector ``bar`` of particle i, as it is to
`cortado.particles.solid_shares.solid_kernel`. Its sum over wall particles b, such as the acceleration by them, is

    A_i = sum_b w_b dW / dbar_i.

Warp makes the gradients of W. Component k of the tangent of A is the change of w_b W for the k-th unit vector as
``bar``, and the adjoint is the gradient of W for the adjoint of A as ``bar``.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import warp as wp

from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.particles.pair_sums import scope_of
from cortado.particles.solid_shares import ALL_WALLS, WorkMaker, solid_kernel
from cortado.particles.terms import Term

LOOP = """\
def {name}(i: int, {parameters}constants: _pair, solid: int, s: _neighbourhood):
    _x_i = at.x[i]
{begin}
    for _place in range(s.fluid_count[i], s.count[i]):
        _b = _neighbour(_place, i, s)
        if solid == _ALL or _wall_solid(_b, s) == solid:
            _w_b = {weight}(_b, s)
            _v_b = _wall_velocity(_b, s)
            _foot = _wall_foot(_b, s)
            _x_ij = _separation(_x_i, _wall_position(_b, s), s)
{body}
{end}
"""


@dataclass(frozen=True)
class WallTerm:
    """A term of walls in a discretisation; ``make(discretisation)`` gives its work."""

    discretisation: Discretisation
    topic: str
    """Of its Warp modules."""
    make: WorkMaker
    bar: str
    """The array in which the work is linear."""
    rubs: bool = False
    """Whether it has nothing of walls that slip freely."""

    @property
    def kernels(self) -> Kernels:
        """Kernels of the sum A, which is ``total``, of its tangent ``total_dot``, and of its adjoint, the array ``bar``
        of the term. They know the ``constants`` of the work and the number ``solid``, or `ALL_WALLS`."""
        return _kernels(self)

    def solid_kernel(self) -> Any:
        """The kernel of what the adjoint gives to a solid that moves."""
        return solid_kernel(self.discretisation, self.topic, self.make, self.rubs)


@cache
def _kernels(of: WallTerm) -> Kernels:
    d = replace(of.discretisation, lanes=1, taped=True)
    precision, term = d.precision, Term.of(of.make(d))
    vector, pair, neighbourhood = precision.vector, precision.pair, neighbourhood_type(precision)
    seen = bundle(**{"x": vector, **{name: kind for name, kind in term.arrays.items() if name not in ("x", of.bar)}})
    given = bundle(**{of.bar: vector})
    plain, topic = replace(d, taped=False), f"{of.topic}_{term.name}_walls"
    modules = plain.module(True, topic), plain.tangent_module(topic), plain.module(False, topic)
    text = _Text(of, term, d, {"_seen": seen, "_given": given})
    total_of, change_of, back = (make(module) for make, module in zip(text.makers(), modules, strict=True))

    @wp.kernel(module=modules[0], enable_backward=False)
    def act(
        s: neighbourhood,
        solid: int,
        constants: pair,
        at: seen,
        # out
        total: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid()
        total[i] = total_of(i, at, constants, solid, s)

    @wp.kernel(module=modules[1], enable_backward=False)
    def act_tangent(
        s: neighbourhood,
        solid: int,
        constants: pair,
        at: seen,
        dot: seen,
        # out
        total_dot: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid()
        total_dot[i] = change_of(i, at, dot, constants, solid, s)

    @wp.kernel(module=modules[2], enable_backward=False)
    def act_adjoint(
        s: neighbourhood,
        solid: int,
        constants: pair,
        at: seen,
        total_bar: given,
        # in and out
        bar: seen,
    ):
        i = s.first + wp.tid()
        back(i, at, total_bar, bar, constants, solid, s)

    return Kernels(act, act_tangent, act_adjoint)


@dataclass(frozen=True)
class _Text:
    """The loops over wall particles of a term, as Warp functions made of texts."""

    of: WallTerm
    term: Term
    d: Discretisation
    bundles: dict[str, Any]

    def makers(self) -> tuple[Any, Any, Any]:
        """What makes the functions of A, of its tangent and of its adjoint in a Warp module."""
        return self._forward, self._tangent, self._adjoint

    @property
    def _entries(self) -> list[str]:
        """Arrays of which it reads the entry of particle i."""
        return [name for name in self.term.arrays if name not in ("x", self.of.bar)]

    def _forward(self, module: Any) -> Any:
        own = [f"_{self.of.bar}_i = _vector()", "_total = _vector()"]
        body = [self._gradients, f"_total += _w_b * _by_{self.of.bar}_i"]
        return self._made("act", "at: _seen, ", own, body, "return _total", module)

    def _tangent(self, module: Any) -> Any:
        moving, zero = self.d.moving, "_vector()"
        dots = {name: f"_{name}_i_dot" for name in ("x", *self._entries)}
        known = {
            "x_ij": f"{dots['x']} - {'_wall_position_dot(_b, s)' if moving else zero}",
            "v_ij": f"{dots.get('v')} - {'_wall_velocity_dot(_b, s)' if moving else zero}",
            "foot": f"_wp.cross({'_wall_turn_dot(_b, s)' if moving else zero}, _foot)",
            **{f"{name}_i": dots[name] for name in self._entries},
        }
        moved = [name for name in self.term.parameters if name in known]
        terms = [self._product(name, f"_change_{name}") for name in moved]
        if moving:  # W is linear in the unit vector, of which its gradient is all that the wall does
            terms.append(f"_wall_growth_dot(_b, s) * _by_{self.of.bar}_i[_k]")
        own = [f"{dot} = dot.{name}[i]" for name, dot in dots.items()]
        own += ["_three = int(3)", "_total = _vector()"]  # not a number: Warp would write the gradient out for each
        body = [f"_change_{name} = {known[name]}" for name in moved]
        body += [
            "for _k in range(_three):",
            f"    _{self.of.bar}_i = _vector()",
            f"    _{self.of.bar}_i[_k] = _real(1.0)",
        ]
        body += [f"    {self._gradients}", f"    _total[_k] += _w_b * ({' + '.join(terms)})"]
        return self._made("act_tangent", "at: _seen, dot: _seen, ", own, body, "return _total", module)

    def _adjoint(self, module: Any) -> Any:
        kinds = {"x": self.d.precision.vector, **{name: self.term.arrays[name] for name in self._entries}}
        own = [f"_{self.of.bar}_i = given.{self.of.bar}[i]"]
        own += [f"_{name}_sum = {self._zero(kind)}" for name, kind in kinds.items()]
        read = {name: next(p for p in (f"{name}_i", f"{name}_ij") if p in self.term.parameters) for name in kinds}
        body = [self._gradients, *(f"_{name}_sum += _w_b * _by_{read[name]}" for name in kinds)]
        end = "\n    ".join(f"bar.{name}[i] = bar.{name}[i] + _{name}_sum" for name in kinds)
        return self._made("act_adjoint", "at: _seen, given: _given, bar: _seen, ", own, body, end, module)

    @property
    def _gradients(self) -> str:
        names = ", ".join(f"_by_{name}" for name in self.term.parameters)
        return f"{names} = _wp.grad(_work)({self.term.seen_from_i({'v': '_v_b'})})"

    def _product(self, name: str, change: str) -> str:
        kind = self.term.parameters[name]
        if kind is self.d.precision.real:
            return f"_by_{name} * {change}"
        return f"_wp.{'dot' if len(kind._shape_) == 1 else 'ddot'}(_by_{name}, {change})"

    def _zero(self, kind: Any) -> str:
        return "_real(0.0)" if kind is self.d.precision.real else "_vector()" if len(kind._shape_) == 1 else "_matrix()"

    def _made(self, name: str, parameters: str, own: list[str], body: list[str], end: str, module: Any) -> Any:
        d = self.d
        own = [*(f"_{entry}_i = at.{entry}[i]" for entry in self._entries), *own]
        text = LOOP.format(
            name=name,
            parameters=parameters,
            begin="\n".join(f"    {line}" for line in own),
            weight="_wall_grip" if self.of.rubs else "_wall_weight",
            body="\n".join(f"            {line}" for line in body),
            end=f"    {end}",
        )
        matrices = [kind for kind in self.term.arrays.values() if kind not in (d.precision.real, d.precision.vector)]
        known: dict[str, Any] = {
            **scope_of(d),
            "_matrix": matrices[0] if matrices else None,
            "_pair": d.precision.pair,
            "_ALL": wp.constant(ALL_WALLS),
            "_wp": wp,
            "_work": wp.func(self.term.function, module=module),
            **self.bundles,
        }
        exec(text, known)
        return wp.Function(known[name], f"{self.term.name}_{name}", "", module=module, source=text)
