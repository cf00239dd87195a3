"""Layers as functions of PyTorch tensors, with forward and reverse mode and `torch.vmap`."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import prod
from typing import Any

import numpy as np
import warp as wp

from cortado.arrays import as_precise_numbers
from cortado.errors import InputError, LibraryMissingError, Words
from cortado.optimisation.layers.layer import Array, Layer, Named
from cortado.optimisation.layers.user_functions import Bridge

try:
    import torch
except ModuleNotFoundError as error:
    raise LibraryMissingError("PyTorch", "torch") from error

SECOND = (
    "A second derivative is asked for, but only first derivatives exist: leave out create_graph=True, or differentiate "
    "within torch.no_grad()."
)
Tensors = tuple[Any, ...]


@dataclass(eq=False)
class Call:
    """The application of a layer to tensors."""

    layer: Layer
    names: tuple[str, ...]
    keep: bool
    residual: Any = None
    many: "Call | None" = field(default=None, repr=False)

    def evaluate(self, tensors: Tensors, keep: bool) -> Tensors:
        with _in_order(_device(self.layer)):
            found, self.residual = self.layer.evaluate(_arrays(self.names, tensors), keep)
            return _tensors(self.layer, found, self.layer.outputs())

    def kept(self, tensors: Tensors) -> Any:
        if self.residual is None:
            self.evaluate(tensors, keep=True)
        return self.residual

    def pull(self, tensors: Tensors, bars: Tensors) -> Tensors:
        with _in_order(_device(self.layer)):
            found = self.layer.pull(self.kept(tensors), _arrays(self.layer.outputs(), bars))
            each = zip(self.names, tensors, strict=True)
            return tuple(_tensor(found[name], tensor.shape, tensor.dtype, tensor.device) for name, tensor in each)

    def push(self, tensors: Tensors, dots: Tensors) -> Tensors:
        with _in_order(_device(self.layer)):
            found = self.layer.push(self.kept(tensors), _arrays(self.names, dots))
            return _tensors(self.layer, found, self.layer.outputs())

    def batched(self, size: int) -> "Call":
        if self.many is None or self.many.layer is not self.layer.batched(size):
            self.many = Call(self.layer.batched(size), self.names, self.keep)
        return self.many


class Evaluate(torch.autograd.Function):
    @staticmethod
    def forward(call: Call, *tensors: Any) -> Tensors:
        return call.evaluate(tensors, call.keep)

    @staticmethod
    def setup_context(ctx: Any, inputs: Tensors, output: Tensors) -> None:
        ctx.call, *tensors = inputs
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(ctx: Any, *bars: Any) -> Tensors:
        if all(bar is None for bar in bars):
            return (None,) * (1 + len(ctx.call.names))
        return None, *Pull.apply(ctx.call, *ctx.saved_tensors, *bars)

    @staticmethod
    def jvp(ctx: Any, _: None, *dots: Any) -> Tensors:
        return Push.apply(ctx.call, *ctx.saved_tensors, *dots)

    @staticmethod
    def vmap(info: Any, in_dims: Sequence[int | None], call: Call, *tensors: Any) -> tuple[Tensors, Any]:
        own = _in_front(tensors, in_dims[1:], info.batch_size)
        found = Evaluate.apply(call.batched(info.batch_size), *own)
        return found, (0,) * len(found)


class _Linear(torch.autograd.Function):
    """A derivative of a layer as a PyTorch function of the layer's tensors and of adjoints or tangents."""

    @staticmethod
    def setup_context(ctx: Any, inputs: Tensors, output: Tensors) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *bars: Any) -> Tensors:
        raise InputError(SECOND)

    @staticmethod
    def jvp(ctx: Any, *dots: Any) -> Tensors:
        raise InputError(SECOND)


def _mapped(function: Any) -> Callable[..., tuple[Tensors, Any]]:

    def vmap(info: Any, in_dims: Sequence[int | None], call: Call, *tensors: Any) -> tuple[Tensors, Any]:
        size, count = info.batch_size, len(call.names)
        if all(dim is None for dim in in_dims[1 : 1 + count]):
            given = _in_front(tensors[count:], in_dims[1 + count :], size)
            each = [tuple(None if one is None else one[b] for one in given) for b in range(size)]
            rows = [function.apply(call, *tensors[:count], *own) for own in each]
            found = tuple(torch.stack(column) for column in zip(*rows, strict=True))
        else:
            found = function.apply(call.batched(size), *_in_front(tensors, in_dims[1:], size))
        return found, (0,) * len(found)

    return vmap


class Pull(_Linear):
    @staticmethod
    def forward(call: Call, *tensors: Any) -> Tensors:
        return call.pull(tensors[: len(call.names)], tensors[len(call.names) :])


class Push(_Linear):
    @staticmethod
    def forward(call: Call, *tensors: Any) -> Tensors:
        return call.push(tensors[: len(call.names)], tensors[len(call.names) :])


for _one in (Pull, Push):
    _one.vmap = staticmethod(_mapped(_one))


class TorchBridge(Bridge):
    stack = staticmethod(torch.stack)

    @torch.compiler.disable
    def apply(self, layer: Layer, given: dict[str, Any]) -> dict[str, Any]:
        unpack = torch.autograd.forward_ad.unpack_dual
        tangents = any(unpack(tensor).tangent is not None for tensor in given.values())
        keep = tangents or (torch.is_grad_enabled() and any(tensor.requires_grad for tensor in given.values()))
        found = Evaluate.apply(Call(layer, tuple(given), keep), *given.values())
        return dict(zip(layer.outputs(), found, strict=True))

    def array(self, what: str, value: Any, layer: Layer) -> Any:
        real = _dtype(layer)
        if not isinstance(value, torch.Tensor):
            return torch.as_tensor(np.array(as_precise_numbers(what, value)), dtype=real, device=_device(layer))
        if value.is_floating_point() and value.dtype != real:
            raise InputError(f"{what} is {value.dtype}, but must be {real}, the simulation's precision.")
        if value.is_complex() or value.dtype == torch.bool or value.layout != torch.strided:
            found = Words(f"a tensor of {value.dtype}, {value.layout}")
            raise InputError(f"{what} is {found}, but must be a dense tensor of real numbers.")
        if value.device.type == "meta" or (what in layer.on_device and value.device != _device(layer)):
            wanted = f"{_device(layer)}, where the simulation is"
            raise InputError(f"{what} is on {value.device}, but must be on {wanted}.")
        return value.to(real)

    def made(self, found: Named, layer: Layer) -> dict[str, Any]:
        shapes = {name: tuple(array.shape) for name, array in found.items()}
        return {name: own.clone() for name, own in zip(shapes, _tensors(layer, found, shapes), strict=True)}

    def mapped(self, loss: Callable[[Any, Any], Any], slope: bool) -> Callable[[Any, Any], tuple[Any, Any]]:
        if not slope:
            return torch.vmap(lambda *given: (loss(*given), {}))
        mapped = torch.vmap(torch.func.grad_and_value(loss))
        return lambda *given: mapped(*given)[::-1]

    def with_gradient(self, found: Callable[[Any], tuple[float, Mapping[str, np.ndarray]]], weights: Any) -> Any:
        """Return the value of ``found`` as a tensor with the gradient of ``found``."""
        value, gradient = found(weights)
        own = {name: array for name, array in weights.items() if isinstance(array, torch.Tensor)}
        moved = (((array - array.detach()) * array.new_tensor(gradient[name])).sum() for name, array in own.items())
        return sum(moved, torch.tensor(value))

    def numbers(self, what: str, value: Any) -> np.ndarray:
        whole = isinstance(value, torch.Tensor) and value.dtype not in (torch.float16, torch.bfloat16)
        return as_precise_numbers(what, value.detach().cpu().numpy() if whole else value)


def _dtype(layer: Layer) -> Any:
    return torch.float64 if layer.real is np.float64 else torch.float32


def _device(layer: Layer) -> Any:
    return torch.device(layer.device.alias)


@contextmanager
def _in_order(device: Any) -> Iterator[None]:
    if device.type != "cuda":
        yield
        return
    theirs, own = wp.stream_from_torch(torch.cuda.current_stream(device)), wp.get_stream(str(device))
    own.wait_stream(theirs)
    yield
    theirs.wait_stream(own)


def _arrays(names: Any, tensors: Tensors) -> dict[str, Array]:
    each = zip(names, tensors, strict=True)
    return {name: _array(tensor) for name, tensor in each if tensor is not None}


def _array(tensor: Any) -> Array:
    tensor = tensor.detach().contiguous()
    return tensor.numpy() if tensor.device.type == "cpu" else wp.from_torch(tensor.reshape(tensor.shape or (1,)))


def _tensors(layer: Layer, found: Named, shapes: dict[str, tuple[int, ...]]) -> Tensors:
    real, device = _dtype(layer), _device(layer)
    each = ((found[name], shape, device if name in layer.on_device else "cpu") for name, shape in shapes.items())
    return tuple(_tensor(array, shape, real, place) for array, shape, place in each)


def _tensor(array: Array, shape: Sequence[int], dtype: Any, device: Any) -> Any:
    own = wp.to_torch(wp.clone(array)) if isinstance(array, wp.array) else torch.from_numpy(np.array(array))
    assert own.numel() == prod(shape)
    return own.to(dtype=dtype, device=device).reshape(tuple(shape))


def _in_front(tensors: Tensors, dims: Sequence[int | None], size: int) -> Tensors:
    each = zip(tensors, dims, strict=True)
    return tuple(
        None if tensor is None else tensor.movedim(dim, 0) if dim is not None else tensor.expand(size, *tensor.shape)
        for tensor, dim in each
    )
