"""What can be optimised: an object with ``value_and_gradient``, such as a `Problem`, or a plain function."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from cortado.errors import InputError, Words, shown

LossFunction = Callable[[dict[str, Any]], tuple[Any, Mapping[str, Any]]]
"""Parameters by name -> the loss, and its gradient by the same names."""


class Optimisable(Protocol):
    """A problem that can be optimised. It may have an attribute `fingerprint`, a text that identifies it.

    The fingerprint is kept in the checkpoint, so that the run of one problem is not resumed with another.
    """

    def value_and_gradient(self, parameters: dict[str, Any], gradient: Any = None) -> tuple[float, Mapping[str, Any]]:
        """The loss, and its gradient by the names and in the shapes of the parameters."""


@dataclass(frozen=True)
class Function:
    """A function of the parameters, which returns its own gradient, as a `Optimisable`."""

    function: LossFunction

    @property
    def fingerprint(self) -> str:
        """The name of the function."""
        kind = type(self.function)
        return str(getattr(self.function, "__qualname__", kind.__qualname__))

    def value_and_gradient(self, parameters: dict[str, Any], gradient: Any = None) -> tuple[float, Mapping[str, Any]]:
        """What the function returns; raises `InputError` where an estimator is given, as the gradient is the function's
        own."""
        if gradient is not None:
            raise InputError("gradient is given, but must be left out where a function makes its own.")
        return self.function(parameters)


def as_differentiable(problem: Any) -> Optimisable:
    """The problem itself, or a function made into one; raises `InputError` for anything else."""
    if isinstance(problem, type):
        raise InputError(f"What is optimised is the class {problem.__name__}, but must be an object made of it.")
    if hasattr(problem, "value_and_gradient"):
        return problem
    if callable(problem):
        return Function(problem)
    raise InputError(
        f"What is optimised is {shown(problem)}, but must be a cortado.Problem, an object with value_and_gradient, or "
        "a function of the parameters that returns its loss and its gradient."
    )


def loss_and_gradient(returned: Any) -> tuple[Any, Mapping[str, Any]]:
    """What an evaluation returned, as its two parts; raises `InputError` if it has no such form."""
    pair = isinstance(returned, (tuple, list)) and len(returned) == 2
    if pair and isinstance(returned[1], Mapping):
        return returned[0], returned[1]
    if pair:
        found: Any = Words(f"a loss and a gradient of type {type(returned[1]).__name__}")
    elif isinstance(returned, (tuple, list)):
        found = Words(f"a {type(returned).__name__} of {len(returned)}")
    else:
        found = returned
    raise InputError(
        f"What is optimised returned {shown(found)}, but must return two things: the loss, a number, and its gradient, "
        "a dictionary with an array for each parameter by its name."
    )
