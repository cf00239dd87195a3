"""Layers as functions of JAX arrays: primitives with derivatives in forward and reverse mode, for `jax.vmap` and for
compiled programs.

Each layer is a JAX primitive. The forward-mode rule of the primitive evaluates the layer and calls a second primitive
for the Jacobian-vector product. The transpose of the second primitive is a third primitive for the vector-Jacobian
product. `jax.jvp` and `jax.grad` therefore use the same rules.

JAX programs contain only arrays. The object `RESIDUALS` therefore stores the residuals of layers. A program carries the
number of a residual in an array, called a ticket.
"""

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import count
from math import prod
from threading import Lock
from typing import Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.arrays import as_precise_numbers
from cortado.errors import InputError, LibraryMissingError, Words
from cortado.optimisation.layers.layer import Array, Layer, Named, on_host, rows, stacked
from cortado.optimisation.layers.user_functions import Bridge

try:
    import jax
    import jax.numpy as jnp
    from jax.extend.core import Primitive
    from jax.interpreters import ad, batching, mlir

    from cortado.optimisation.layers.foreign import ForeignFunction
except ModuleNotFoundError as error:
    raise LibraryMissingError("JAX", "jax") from error

SECOND = "A second derivative is asked for, but only first derivatives exist: differentiate once."
MOST_KEPT = 2**30
TICKET = 2
"""Number of integers in a ticket."""
NO_TICKETS = np.zeros(TICKET, dtype=np.int32)
Kept = tuple[Layer, int | None, Any]
Names = tuple[str, ...]
Sizes = tuple[int, ...]
Arrays = Sequence[Any]
Way = Literal["push", "pull"]


class Residuals:
    def __init__(self) -> None:
        self._kept: OrderedDict[int, Kept] = OrderedDict()
        self._numbers, self._lock = count(1), Lock()

    def __len__(self) -> int:
        return len(self._kept)

    def put(self, kept: Kept) -> int:
        with self._lock:
            number = next(self._numbers) % 2**31
            self._kept[number] = kept
            while len(self._kept) > 1 and sum(layer.kept_bytes for layer, *_ in self._kept.values()) > MOST_KEPT:
                self._kept.popitem(last=False)
            return number

    def get(self, number: int, last: bool) -> Kept | None:
        with self._lock:
            return self._kept.pop(number, None) if last else self._kept.get(number)


RESIDUALS = Residuals()


def evaluate(layer: Layer, entries: int | None, given: Named, keep: bool) -> tuple[Named, NDArray[np.int32]]:
    """Return the results of a layer. Unless ``entries`` is None, the layer is mapped over a first axis of length
    ``entries``. If ``keep`` is true, the layer's residual is stored under the returned tickets (entries, 2) or (2,).
    """
    own = layer if entries is None else layer.batched(entries)
    found, residual = own.evaluate(given, keep)
    if not keep:
        return found, NO_TICKETS
    number = RESIDUALS.put((own, entries, residual))
    tickets = np.stack([np.full(entries or 1, number), np.arange(entries or 1)], axis=1).astype(np.int32)
    return found, tickets[0] if entries is None else tickets


def derivative(
    way: Way, layer: Layer, entries: int | None, tickets: NDArray[np.int32], given: Named, others: Named
) -> Named:
    """Compute a Jacobian-vector product or a vector-Jacobian product of a layer at the arguments ``given``. ``others``
    are tangents of the arguments or adjoints of the results. ``tickets`` identify the residual."""
    numbers, places = tickets.reshape(-1, TICKET).T
    last = way == "pull"
    kept = RESIDUALS.get(int(numbers[0]), last) if (numbers == numbers[0]).all() else None
    if kept is None:
        own = evaluate(layer, entries, given, keep=True)[1].reshape(-1, TICKET)
        kept, places = RESIDUALS.get(int(own[0, 0]), last), own[:, 1]
    assert kept is not None
    own_layer, mapped, residual = kept
    derived: Callable[[Any, Named], Named] = getattr(own_layer, way)
    if mapped == entries:
        return derived(residual, others)
    order = np.argsort(places, kind="stable").reshape(mapped or 1, -1).T  # (directions, entries of the layer)
    turns: Sequence[Any] = [row if mapped is not None else int(row[0]) for row in order]
    whole = stacked(derived(residual, rows(others, turn)) for turn in turns)
    if mapped is not None:
        whole = {name: array.reshape((-1, *array.shape[2:])) for name, array in whole.items()}
    return rows(whole, np.argsort(order.reshape(-1)))


def _evaluated(arrays: Arrays, *, layer: Layer, names: Names, sizes: Sizes, keep: bool) -> list[Array]:
    found, tickets = evaluate(layer, prod(sizes) if sizes else None, dict(zip(names, arrays, strict=True)), keep)
    own = [found[name] for name in layer.outputs()]
    return [*own, tickets] if keep else own


def _derived(way: Way, arrays: Arrays, *, layer: Layer, names: Names, along: Names, sizes: Sizes) -> list[Array]:
    tickets, *rest = arrays
    given, outputs = dict(zip(names, rest[: len(names)], strict=True)), tuple(layer.outputs())
    along, wanted = (along, outputs) if way == "push" else (outputs, along)
    others = dict(zip(along, rest[len(names) :], strict=True))
    found = derivative(way, layer, prod(sizes) if sizes else None, on_host(tickets), given, others)
    return [found[name] for name in wanted]


def _results(*avals: Any, layer: Layer, sizes: Sizes, keep: bool = False, **others: Any) -> list[Any]:
    found = [jax.core.ShapedArray((*sizes, *shape), layer.real) for shape in layer.outputs().values()]
    return [*found, jax.core.ShapedArray((*sizes, TICKET), np.int32)] if keep else found


def _of_given(number: Any, *avals: Any, names: Names, along: Names, **others: Any) -> list[Any]:
    each = dict(zip(names, avals, strict=False))
    return [jax.core.ShapedArray(each[name].shape, each[name].dtype) for name in along]


def _primitive(name: str, run: Callable[..., list[Array]], results: Callable[..., list[Any]]) -> Any:
    made = Primitive(f"cortado_{name}")
    made.multiple_results = True
    made.def_abstract_eval(results)

    def flat(shape: Sizes, sizes: Sizes) -> Sizes:
        return (prod(sizes), *shape[len(sizes) :]) if sizes else shape

    def flattened(arrays: Arrays, sizes: Sizes) -> list[Any]:
        return [array.reshape(flat(array.shape, sizes)) if sizes else array for array in arrays]

    def at_once(*arrays: Any, **options: Any) -> list[Any]:
        given = flattened([_array(array) for array in arrays], options["sizes"])
        wanted = results(*arrays, **options)
        return [_jax_array(*own) for own in zip(run(given, **options), wanted, strict=True)]

    def compiled(context: Any, *arrays: Any, **options: Any) -> Any:
        foreign, sizes = ForeignFunction(partial(run, **options)), options["sizes"]
        context.module_context.add_keepalive(foreign)

        def call(*traced: Any) -> list[Any]:
            return foreign(*flattened(traced, sizes), results=results(*traced, **options))

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
push_p = _primitive("push", partial(_derived, "push"), _results)
pull_p = _primitive("pull", partial(_derived, "pull"), _of_given)


def _evaluate_forward(arrays: Arrays, dots: Arrays, *, keep: bool, **options: Any) -> tuple[Any, Any]:
    *found, number = evaluate_p.bind(*arrays, keep=True, **options)
    there = [(name, dot) for name, dot in zip(options["names"], dots, strict=True) if type(dot) is not ad.Zero]
    along, own = tuple(name for name, _ in there), [dot for _, dot in there]
    tangents = push_p.bind(number, *arrays, *own, along=along, **options)
    if not keep:
        return found, tangents
    return [*found, number], [*tangents, ad.Zero(jax.core.ShapedArray(number.shape, jax.dtypes.float0))]


def _transposed(
    transpose: Any, bars: Arrays, number: Any, *given: Any, names: Names, along: Names, **options: Any
) -> list[Any]:
    own = [ad.instantiate_zeros(bar) for bar in bars]
    found = transpose.bind(number, *given[: len(names)], *own, names=names, along=along, **options)
    return [None] * (1 + len(names)) + list(found)


def _linear_forward(primitive: Any, given: Arrays, dots: Arrays, *, names: Names, **options: Any) -> tuple[Any, Any]:
    fixed = 1 + len(names)
    if any(type(dot) is not ad.Zero for dot in dots[1:fixed]):
        raise InputError(SECOND)
    own = [ad.instantiate_zeros(dot) for dot in dots[fixed:]]
    return (
        primitive.bind(*given, names=names, **options),
        primitive.bind(*given[:fixed], *own, names=names, **options),
    )


ad.primitive_jvps[evaluate_p] = _evaluate_forward
for _one, _other in ((push_p, pull_p), (pull_p, push_p)):
    ad.primitive_jvps[_one] = partial(_linear_forward, _one)
    ad.primitive_transposes[_one] = partial(_transposed, _other)


class JaxBridge(Bridge):
    stack = staticmethod(jnp.stack)

    def apply(self, layer: Layer, given: dict[str, Any]) -> dict[str, Any]:
        found = evaluate_p.bind(*given.values(), layer=layer, names=tuple(given), sizes=(), keep=False)
        return dict(zip(layer.outputs(), found, strict=True))

    def array(self, what: str, value: Any, layer: Layer) -> Any:
        real = np.dtype(layer.real)
        if real == np.float64 and not jax.config.jax_enable_x64:
            raise InputError(
                "precision of the simulation is float64, but must be float32, as JAX computes in float32: call "
                'jax.config.update("jax_enable_x64", True) before anything else, or make the simulation in float32.'
            )
        if not isinstance(value, jax.Array):
            return jnp.asarray(as_precise_numbers(what, value), dtype=real)
        if jnp.issubdtype(value.dtype, jnp.floating) and value.dtype != real and not value.weak_type:
            raise InputError(f"{what} is {value.dtype}, but must be {real}, the simulation's precision.")
        if not jnp.issubdtype(value.dtype, jnp.floating) and not jnp.issubdtype(value.dtype, jnp.integer):
            found = Words(f"an array of {value.dtype}")
            raise InputError(f"{what} is {found}, but must be an array of real numbers.")
        return value.astype(real)

    def made(self, found: Named, layer: Layer) -> dict[str, Any]:
        return {name: self.array(name, np.array(on_host(array)), layer) for name, array in found.items()}

    def repeated(
        self, step: Callable[[Any, Any], Any], state: dict[str, Any], rows: dict[str, Any], count: int
    ) -> dict[str, Any]:
        if not any(isinstance(array, jax.core.Tracer) for array in jax.tree.leaves((state, rows))):
            return super().repeated(step, state, rows, count)

        def body(before: Any, own: Any) -> tuple[Any, Any]:
            after = step(before, own)
            return after, after

        _, found = jax.lax.scan(body, state, rows, length=count)
        return {name: jnp.concatenate([state[name][None], own]) for name, own in found.items()}

    def mapped(self, loss: Callable[[Any, Any], Any], slope: bool) -> Callable[[Any, Any], tuple[Any, Any]]:
        return jax.jit(jax.vmap(jax.value_and_grad(loss) if slope else lambda *given: (loss(*given), {})))

    def with_gradient(self, found: Callable[[Any], tuple[float, Mapping[str, np.ndarray]]], weights: Any) -> Any:
        """Return the value of ``found``, with its gradient as a custom JAX rule. Compiled programs cannot use the
        rule."""

        def forward(given: Any) -> tuple[Any, Any]:
            if any(isinstance(array, jax.core.Tracer) for array in given.values()):
                raise InputError("weights are JAX tracers, but must be arrays: call the loss without jit and vmap.")
            value, gradient = found(given)
            return jnp.asarray(value), {name: jnp.asarray(gradient[name], own.dtype) for name, own in given.items()}

        smoothed = jax.custom_vjp(lambda given: forward(given)[0])
        smoothed.defvjp(forward, lambda gradient, bar: ({name: bar * own for name, own in gradient.items()},))
        return smoothed({name: jnp.asarray(array, float) for name, array in weights.items()})


def _array(array: Any) -> Array:
    """Return a JAX array as a NumPy or Warp array in the same memory."""
    if not isinstance(array, jax.Array) or next(iter(array.devices())).platform == "cpu":
        return np.asarray(array)
    return wp.from_dlpack(array.reshape(array.shape or (1,)))


def _jax_array(found: Array, wanted: Any) -> Any:
    if isinstance(found, wp.array) and not found.device.is_cpu:
        return jnp.from_dlpack(wp.clone(found)).astype(wanted.dtype).reshape(wanted.shape)
    own = found.numpy() if isinstance(found, wp.array) else np.asarray(found)
    return jnp.array(own.reshape(wanted.shape), dtype=wanted.dtype)
