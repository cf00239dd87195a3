"""The operations of a policy's loop on tensors of PyTorch, beside those on arrays of JAX in `policies`."""

from collections.abc import Callable
from typing import Any

import torch

import cortado.torch


class InTorch:
    """The operations of a loop on tensors."""

    layers, cat, stack, tanh, sin, cos = cortado.torch, torch.cat, torch.stack, torch.tanh, torch.sin, torch.cos
    least = staticmethod(lambda x: x.amin(-1))

    @staticmethod
    def array(x: Any) -> Any:
        return torch.as_tensor(x, dtype=torch.float32)

    @staticmethod
    def scan(act: Callable[[Any, Any], tuple[Any, Any]], begun: Any, count: int) -> Any:
        found = []
        for number in range(count):
            begun, one = act(begun, float(number))
            found.append(one)
        return torch.stack(found)

    @staticmethod
    def compiled(loss: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        return torch.no_grad()(loss)

    @staticmethod
    def with_slope(loss: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        def found(weights: Any, start: Any) -> Any:
            own = weights.requires_grad_()
            value = loss(own, start)
            return value.detach(), torch.autograd.grad(value, own)[0]

        return found
