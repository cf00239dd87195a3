"""Layers as functions of JAX's arrays: primitives with rules for both modes, for `jax.vmap` and for compiled programs.

A layer is one primitive. Its rule of forward mode applies it with the number of its residual as a further result, and
then a second primitive, the tangent, which is linear in tangents; the transpose of this is a third, the adjoint. So
`jax.jvp` and `jax.grad` come from the same rules, and both are linear functions that JAX may transpose again.
"""

from collections.abc import Callable, Sequence
from functools import partial
from math import prod
from typing import Any

import numpy as np
import warp as wp

from cortado.arrays import as_precise_numbers
from cortado.errors import InputError, LibraryMissingError, Words
from cortado.optimisation.layers import residuals
from cortado.optimisation.layers.compiled import ForeignFunction
from cortado.optimisation.layers.layer import Array, Layer, Named, on_host

try:
    import jax
    import jax.numpy as jnp
    from jax.extend.core import Primitive
    from jax.interpreters import ad, batching, mlir
except ModuleNotFoundError as error:
    raise LibraryMissingError("JAX", "jax") from error

SECOND = "A second derivative is asked for, but there are first ones only: differentiate once."
Names = tuple[str, ...]
Sizes = tuple[int, ...]
"""Over how many entries a layer is mapped, along one axis after the other."""
Arrays = Sequence[Any]


def _evaluated(arrays: Arrays, *, layer: Layer, names: Names, sizes: Sizes, keep: bool) -> list[Array]:
    found, tickets = residuals.evaluate(layer, _entries(sizes), dict(zip(names, arrays, strict=True)), keep)
    own = [found[name] for name in layer.outputs()]
    return [*own, tickets] if keep else own


def _pushed(arrays: Arrays, *, layer: Layer, names: Names, along: Names, sizes: Sizes) -> list[Array]:
    tickets, given, dots = _taken_apart(arrays, names, along)
    found = residuals.push(layer, _entries(sizes), tickets, given, dots)
    return [found[name] for name in layer.outputs()]


def _pulled(arrays: Arrays, *, layer: Layer, names: Names, along: Names, sizes: Sizes) -> list[Array]:
    tickets, given, bars = _taken_apart(arrays, names, tuple(layer.outputs()))
    found = residuals.pull(layer, _entries(sizes), tickets, given, bars)
    return [found[name] for name in along]


def _entries(sizes: Sizes) -> int | None:
    """Over how many entries a layer is mapped, if it is."""
    return prod(sizes) if sizes else None


def _taken_apart(arrays: Arrays, names: Names, others: Names) -> tuple[np.ndarray, Named, Named]:
    tickets, *rest = arrays
    given = dict(zip(names, rest[: len(names)], strict=True))
    return on_host(tickets), given, dict(zip(others, rest[len(names) :], strict=True))


def _results(*avals: Any, layer: Layer, sizes: Sizes, keep: bool = False, **others: Any) -> list[Any]:
    """The shapes and types of what a layer returns."""
    found = [jax.core.ShapedArray((*sizes, *shape), layer.real) for shape in layer.outputs().values()]
    return [*found, jax.core.ShapedArray((*sizes, residuals.TICKET), np.int32)] if keep else found


def _of_given(number: Any, *avals: Any, names: Names, along: Names, **others: Any) -> list[Any]:
    """Those of some arrays that were given."""
    each = dict(zip(names, avals, strict=False))
    return [jax.core.ShapedArray(each[name].shape, each[name].dtype) for name in along]


def _primitive(name: str, run: Callable[..., list[Array]], results: Callable[..., list[Any]]) -> Any:
    """A primitive that runs a function of arrays, of what is mapped with one axis for all of it."""
    made = Primitive(f"cortado_{name}")
    made.multiple_results = True
    made.def_abstract_eval(results)

    def flat(array: Any, sizes: Sizes) -> Any:
        return array.reshape((prod(sizes), *array.shape[len(sizes) :])) if sizes else array

    def at_once(*arrays: Any, **options: Any) -> list[Any]:
        given = [flat(_array(array), options["sizes"]) for array in arrays]
        wanted = results(*arrays, **options)
        return [_jax_array(*own) for own in zip(run(given, **options), wanted, strict=True)]

    def compiled(context: Any, *arrays: Any, **options: Any) -> Any:
        foreign = ForeignFunction(partial(run, **options))
        context.module_context.add_keepalive(foreign)

        def call(*traced: Any) -> list[Any]:
            sizes = options["sizes"]
            wanted = [jax.ShapeDtypeStruct(own.shape, own.dtype) for own in results(*traced, **options)]
            flattened = [
                jax.ShapeDtypeStruct((prod(sizes), *own.shape[len(sizes) :]) if sizes else own.shape, own.dtype)
                for own in wanted
            ]
            found = foreign(*(flat(array, sizes) for array in traced), results=flattened)
            return [array.reshape(own.shape) for array, own in zip(found, wanted, strict=True)]

        return mlir.lower_fun(call, multiple_results=True)(context, *arrays)

    def mapped(arrays: Arrays, dims: Sequence[int | None], *, layer: Layer, sizes: Sizes, **options: Any) -> Any:
        size = next(a.shape[d] for a, d in zip(arrays, dims, strict=True) if d is not None)
        layer.check_mapped()
        each = zip(arrays, dims, strict=True)
        own = [jnp.broadcast_to(a, (size, *a.shape)) if d is None else jnp.moveaxis(a, d, 0) for a, d in each]
        found = made.bind(*own, layer=layer, sizes=(size, *sizes), **options)
        return found, [0] * len(found)

    made.def_impl(at_once)
    mlir.register_lowering(made, compiled, cacheable=False)
    batching.primitive_batchers[made] = mapped
    return made


evaluate_p = _primitive("evaluate", _evaluated, _results)
push_p = _primitive("push", _pushed, _results)
pull_p = _primitive("pull", _pulled, _of_given)


def _evaluate_forward(arrays: Arrays, dots: Arrays, *, keep: bool, **options: Any) -> tuple[Any, Any]:
    """The rule of forward mode of a layer."""
    *found, number = evaluate_p.bind(*arrays, keep=True, **options)
    there = [(name, dot) for name, dot in zip(options["names"], dots, strict=True) if type(dot) is not ad.Zero]
    along, own = tuple(name for name, _ in there), [dot for _, dot in there]
    tangents = push_p.bind(number, *arrays, *own, along=along, **options)
    if not keep:
        return found, tangents
    return [*found, number], [*tangents, ad.Zero(jax.core.ShapedArray(number.shape, jax.dtypes.float0))]


def _push_transposed(bars: Arrays, number: Any, *given: Any, names: Names, along: Names, **options: Any) -> list[Any]:
    arrays = given[: len(names)]
    own = [ad.instantiate_zeros(bar) for bar in bars]
    found = pull_p.bind(number, *arrays, *own, names=names, along=along, **options)
    return [None] * (1 + len(names)) + list(found)


def _pull_transposed(dots: Arrays, number: Any, *given: Any, names: Names, along: Names, **options: Any) -> list[Any]:
    arrays = given[: len(names)]
    own = [ad.instantiate_zeros(dot) for dot in dots]
    found = push_p.bind(number, *arrays, *own, names=names, along=along, **options)
    return [None] * (1 + len(names)) + list(found)


def _linear_forward(primitive: Any, given: Arrays, dots: Arrays, *, names: Names, **options: Any) -> tuple[Any, Any]:
    """The rule of forward mode of a linear primitive, whose first arrays have no derivative."""
    fixed = 1 + len(names)
    if any(type(dot) is not ad.Zero for dot in dots[1:fixed]):
        raise InputError(SECOND)
    own = [ad.instantiate_zeros(dot) for dot in dots[fixed:]]
    return (
        primitive.bind(*given, names=names, **options),
        primitive.bind(*given[:fixed], *own, names=names, **options),
    )


ad.primitive_jvps[evaluate_p] = _evaluate_forward
ad.primitive_jvps[push_p] = partial(_linear_forward, push_p)
ad.primitive_jvps[pull_p] = partial(_linear_forward, pull_p)
ad.primitive_transposes[push_p] = _push_transposed
ad.primitive_transposes[pull_p] = _pull_transposed


class JaxBridge:
    """What calls of layers need of JAX."""

    def apply(self, layer: Layer, given: dict[str, Any]) -> dict[str, Any]:
        """What a layer returns, by name."""
        found = evaluate_p.bind(*given.values(), layer=layer, names=tuple(given), sizes=(), keep=False)
        return dict(zip(layer.outputs(), found, strict=True))

    def array(self, what: str, value: Any, layer: Layer) -> Any:
        """An array of the layer's precision, as it is, or numbers as one; raises `InputError` for any other."""
        real = np.dtype(layer.real)
        if real == np.float64 and not jax.config.jax_enable_x64:
            raise InputError(
                "precision of the simulation is float64, but must be float32 where JAX computes in that: call "
                'jax.config.update("jax_enable_x64", True) before anything else, or make the simulation in float32.'
            )
        if not isinstance(value, jax.Array):
            return jnp.asarray(as_precise_numbers(what, value), dtype=real)
        if jnp.issubdtype(value.dtype, jnp.floating) and value.dtype != real and not value.weak_type:
            raise InputError(f"{what} is {value.dtype}, but must be {real}, the simulation's precision.")
        if not jnp.issubdtype(value.dtype, jnp.floating) and not jnp.issubdtype(value.dtype, jnp.integer):
            found = Words(f"an array of {value.dtype}")
            raise InputError(f"{what} is {found}, but must be one of real numbers.")
        return value.astype(real)

    def made(self, found: Named, layer: Layer) -> dict[str, Any]:
        """Arrays of a layer as JAX's."""
        return {name: self.array(name, np.array(on_host(array)), layer) for name, array in found.items()}

    def numbers(self, what: str, value: Any) -> np.ndarray:
        """An array on the host, in float64."""
        return as_precise_numbers(what, value)

    def repeated(
        self, step: Callable[[Any, Any], Any], state: dict[str, Any], rows: dict[str, Any], count: int
    ) -> dict[str, Any]:
        """The states that a step leads to again and again, with the next row of each array, and the first one, along a
        first axis."""
        if not any(isinstance(array, jax.core.Tracer) for array in jax.tree.leaves((state, rows))):
            states = [state]
            for k in range(count):
                states.append(step(states[-1], {name: row[k] for name, row in rows.items()}))
            return {name: jnp.stack([one[name] for one in states]) for name in state}

        def body(before: Any, own: Any) -> tuple[Any, Any]:
            after = step(before, own)
            return after, after

        _, found = jax.lax.scan(body, state, rows, length=count)
        return {name: jnp.concatenate([state[name][None], own]) for name, own in found.items()}


def _array(array: Any) -> Array:
    """One that is there, in its memory."""
    if not isinstance(array, jax.Array) or next(iter(array.devices())).platform == "cpu":
        return np.asarray(array)
    return wp.from_dlpack(array.reshape(array.shape or (1,)))


def _jax_array(found: Array, wanted: Any) -> Any:
    """What a layer returned."""
    if isinstance(found, wp.array) and not found.device.is_cpu:
        return jnp.from_dlpack(found).astype(wanted.dtype).reshape(wanted.shape)
    own = found.numpy() if isinstance(found, wp.array) else np.asarray(found)
    return jnp.array(own.reshape(wanted.shape), dtype=wanted.dtype)
