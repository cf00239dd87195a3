"""Layers for programs that hold arrays alone: what a derivative needs is found again by a ticket, which is one."""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from itertools import count
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.optimisation.layers.layer import Layer, Named, rows, stacked

MOST_KEPT = 2**30
"""Bytes of residuals that wait for a derivative; the oldest ones beyond are computed again when they are needed."""
TICKET = 2
"""How many whole numbers it has: that of the residual, and that of an entry, where a layer is mapped over several."""


Kept = tuple[Layer, int | None, Any]


class Residuals:
    """Residuals by their numbers, each with its layer and how many entries this is mapped over, None if it is not."""

    def __init__(self) -> None:
        self._kept: OrderedDict[int, Kept] = OrderedDict()
        self._numbers, self._lock = count(1), Lock()

    def __len__(self) -> int:
        return len(self._kept)

    def put(self, kept: "Kept") -> int:
        """The number of one."""
        with self._lock:
            number = next(self._numbers) % 2**31
            self._kept[number] = kept
            while len(self._kept) > 1 and sum(layer.kept_bytes for layer, *_ in self._kept.values()) > MOST_KEPT:
                self._kept.popitem(last=False)
            return number

    def get(self, number: int, last: bool) -> "Kept | None":
        """That of a number; None if it is gone, as it is once somebody was the ``last`` to take it."""
        with self._lock:
            return self._kept.pop(number, None) if last else self._kept.get(number)


RESIDUALS = Residuals()


def evaluate(layer: Layer, entries: int | None, given: Named, keep: bool) -> tuple[Named, NDArray[np.int32]]:
    """What a layer returns, mapped over so many entries along a first axis; and, to ``keep``, the tickets (entries, 2)
    of its residual, or (2,), else 0."""
    own = layer if entries is None else layer.batched(entries)
    found, residual = own.evaluate(given, keep)
    number = RESIDUALS.put((own, entries, residual)) if keep else 0
    tickets = np.stack([np.full(entries or 1, number), np.arange(entries or 1)], axis=1).astype(np.int32)
    return found, tickets[0] if entries is None else tickets


def push(layer: Layer, entries: int | None, tickets: NDArray[np.int32], given: Named, dots: Named) -> Named:
    """The tangents of what a layer returned, from those of arrays ``given`` to it, by the tickets of its residual."""
    return _derivative(layer, entries, tickets, given, dots, lambda own, kept, one: own.push(kept, one), last=False)


def pull(layer: Layer, entries: int | None, tickets: NDArray[np.int32], given: Named, bars: Named) -> Named:
    """The adjoints of all arrays ``given``, from those of what the layer returned."""
    return _derivative(layer, entries, tickets, given, bars, lambda own, kept, one: own.pull(kept, one), last=True)


def _derivative(
    layer: Layer,
    entries: int | None,
    tickets: NDArray[np.int32],
    given: Named,
    others: Named,
    derivative: Callable[[Layer, Any, Named], Named],
    last: bool,
) -> Named:
    """Derivatives that are mapped over so many entries, of a layer that was mapped over these, over a part of them, as
    where it is differentiated along several directions, or not at all."""
    numbers, places = tickets.reshape(-1, TICKET).T
    kept = RESIDUALS.get(int(numbers[0]), last) if (numbers == numbers[0]).all() else None
    if kept is None:
        own = evaluate(layer, entries, given, keep=True)[1].reshape(-1, TICKET)
        kept, places = RESIDUALS.get(int(own[0, 0]), last), own[:, 1]
    assert kept is not None
    own_layer, mapped, residual = kept
    if mapped == entries:
        return derivative(own_layer, residual, others)
    order = np.argsort(places, kind="stable").reshape(mapped or 1, -1).T  # (directions, entries of the layer)
    turns: Sequence[Any] = [row if mapped is not None else int(row[0]) for row in order]
    found = [derivative(own_layer, residual, rows(others, turn)) for turn in turns]
    whole = stacked(found)
    if mapped is not None:
        whole = {name: array.reshape((-1, *array.shape[2:])) for name, array in whole.items()}
    return rows(whole, np.argsort(order.reshape(-1)))
