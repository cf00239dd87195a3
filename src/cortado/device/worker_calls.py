"""A call of a function as it travels to a worker process, and its answer as it comes back.

A worker keeps the last functions that it was sent, so that a problem is made once in each process and not for each of
its evaluations.
"""

import pickle
import threading
import traceback
import warnings
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from hashlib import sha256
from importlib import metadata
from typing import Any

from cortado.errors import ComputationError, CortadoError, InputError, warn
from cortado.version import __version__

KEPT = 2
"""Number of functions that a worker process keeps, the last ones used. Each may hold a problem with all its memory."""

_functions: OrderedDict[str, Callable[[Any], Any]] = OrderedDict()
_one_at_a_time = threading.RLock()


@dataclass(frozen=True)
class Payload:
    """A function on its way to a worker process."""

    digest: str
    """A checksum of the pickled function."""
    versions: str
    """The `versions` of the process that pickled the function."""
    content: bytes | None
    """The pickled function; None where a worker should have it."""

    @classmethod
    def of(cls, function: Callable[[Any], Any]) -> "Payload":
        """Pickle a function into a payload; raises `InputError` where that is impossible."""
        content = pickled(function, "The function")
        return cls(sha256(content).hexdigest(), versions(), content)

    @property
    def mention(self) -> "Payload":
        """Payload without its content."""
        return replace(self, content=None)


@dataclass(frozen=True)
class Lacking:
    """The answer of a worker process that does not have the called function yet and was not sent it."""


@dataclass(frozen=True)
class Answer:
    """The result of a call in a worker process, or its error."""

    content: bytes = b""
    """The result, pickled in the worker, so that a result that cannot be pickled is an error of the call."""
    error: BaseException | None = None
    traceback: str = ""
    """The traceback of an error that is none of Cortado's own."""
    warnings: tuple[tuple[str, type[Warning]], ...] = ()
    """(text, category) of each warning."""

    def result(self) -> Any:
        """Return the function's result, with its warnings given here; raises its error."""
        for text, category in self.warnings:
            warn(text, category)
        if self.error is None:
            return pickle.loads(self.content)
        if self.traceback:
            self.error.add_note(f"In a worker process:\n{self.traceback}")
        raise self.error


def pickled(value: Any, what: str) -> bytes:
    """Pickle a value with the code of classes and functions of the main module; raises `InputError` where that is
    impossible, in a sentence that begins with ``what``."""
    import cloudpickle

    try:
        return cloudpickle.dumps(value)
    except Exception as error:  # pickling may raise anything
        raise InputError(f"{what} cannot be sent to another process: {in_words(error)}.") from error


@cache
def versions() -> str:
    """Return the versions that determine the bits of a result, in words."""
    return f"Cortado {__version__}, Warp {metadata.version('warp-lang')} and NumPy {metadata.version('numpy')}"


def call(payload: Payload, item: bytes) -> Answer | Lacking:
    """Call the payload's function for an item, in a worker process, one call at a time. Its exceptions become part of
    the answer, to be raised again by the caller, also one that would end the process."""
    with _one_at_a_time, warnings.catch_warnings(record=True) as caught:
        if payload.content is None and payload.digest not in _functions:
            return Lacking()
        warnings.simplefilter("always")
        try:
            answer = Answer(pickled(_function(payload)(_unpickled(item)), "The result"))
        except Exception as error:
            answer = Answer(
                error=_sendable(error), traceback="" if isinstance(error, CortadoError) else traceback.format_exc()
            )
        except BaseException as error:  # sys.exit, or KeyboardInterrupt
            how = in_words(error)
            answer = Answer(
                error=ComputationError(f"An item ended its process, by {how}; what is computed may not do so.")
            )
    said = tuple((str(warning.message), warning.category) for warning in caught)
    return replace(answer, warnings=said)


def _function(payload: Payload) -> Callable[[Any], Any]:
    """Return the function of a payload, unpickled unless it is kept."""
    if payload.versions != versions():
        raise InputError(
            f"A worker has {versions()}, but must have {payload.versions}, as the process that asks it has: else bits "
            "would differ."
        )
    if payload.digest not in _functions:
        assert payload.content is not None
        while len(_functions) >= KEPT:
            _functions.popitem(last=False)
        _functions[payload.digest] = _unpickled(payload.content)
    _functions.move_to_end(payload.digest)
    return _functions[payload.digest]


def _unpickled(content: bytes) -> Any:
    try:
        return pickle.loads(content)
    except CortadoError:
        raise
    except Exception as error:  # unpickling may raise anything
        raise InputError(
            f"A worker cannot make what it was sent: {in_words(error)}; classes and functions that are sent must be in "
            "a module that every worker can import."
        ) from error


def _sendable(error: Exception) -> BaseException:
    """Return an error, or one with equal words if it cannot be pickled."""
    try:
        again = pickle.loads(pickle.dumps(error))
        if type(again) is type(error) and str(again) == str(error):
            return error
    except Exception:  # pickling may raise anything
        pass
    return RuntimeError(in_words(error))


def in_words(error: BaseException) -> str:
    """Return an error in words, on one line, without the full stop."""
    text = " ".join(str(error).split()).rstrip(".")
    return text if isinstance(error, CortadoError) else ": ".join(filter(None, [type(error).__name__, text]))
