"""The protocol of executors, and the one that computes in this process."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, TypeVar

from cortado.arrays import require_arguments, require_function
from cortado.errors import InputError, shown

Item = TypeVar("Item")
Result = TypeVar("Result")
OnResult = Callable[[int, Any], None]
"""Called in the caller's thread with the number of an item, from 0, and its result, as results arrive."""


class Executor(ABC):
    """Computes a function of many items that do not depend on one another.

    Where an executor computes changes no bit of a result on the same kind of processor.
    """

    def threads(self) -> int:
        """How many items are computed at a time."""
        return 1

    @abstractmethod
    def map(
        self, function: Callable[[Item], Result], items: Iterable[Item], on_result: OnResult | None = None
    ) -> list[Result]:
        """The function's result for every item, in the order of the items.

        The function keeps what is large, such as a problem, and items are small. Items are taken as they are needed.
        Raises what the function raised for the first item, in their order, for which it raised anything.
        """


@dataclass(frozen=True)
class InProcess(Executor):
    """Computes one item after the other in this process."""

    def map(
        self, function: Callable[[Item], Result], items: Iterable[Item], on_result: OnResult | None = None
    ) -> list[Result]:
        check_call(function, items, on_result)
        results = []
        for number, item in enumerate(items):
            results.append(function(item))
            if on_result is not None:
                on_result(number, results[-1])
        return results


def check_call(function: Any, items: Any, on_result: Any) -> None:
    """Raises `InputError` for arguments of `Executor.map` that it cannot work with."""
    require_arguments("function", function, ("an item",))
    if not isinstance(items, Iterable):
        raise InputError(f"items is {shown(items)}, but must be a list of them.")
    require_function("on_result", on_result, "the number of an item", "its result")


def checked_executor(executor: Any) -> Executor:
    """The executor; raises `InputError` for anything else, such as a client of Dask, whose ``map`` is another."""
    if not isinstance(executor, Executor):
        is_class = isinstance(executor, type)
        found = f"the class {executor.__name__}" if is_class else f"of the type {type(executor).__name__}"
        raise InputError(
            f"executor is {found}, but must be an object such as cortado.executors.InProcess() or "
            "Distributed(scheduler)."
        )
    return executor
