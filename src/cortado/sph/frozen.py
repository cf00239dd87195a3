"""What a user's function names that is not its own: as it is when the force is made, and in words."""

from copy import deepcopy
from inspect import isclass, ismodule
from types import CellType, FunctionType, ModuleType
from typing import Any

import warp as wp

from cortado.code_words import KEPT, SNIPPETS, names_in, package_of, read_by, words
from cortado.device.modules import kernel_module
from cortado.sph.function_source import check_bare, definition


class Frozen:
    """The scope of a function and of all that it calls: numbers, vectors, and what modules and objects have of the
    attributes that it reads, are copies. So are functions under ``@wp.func``, whose scopes are frozen too."""

    def __init__(self, what: str, function: FunctionType):
        """Raises `InputError` where a function that it calls is not what its text says."""
        self._what, self._made = what, dict[Any, Any]()
        self.helpers: list[Any] = []
        """The copies of functions of Warp's users, in each of their forms."""
        self.scope = self._scope(function)
        """What names stand for."""
        self.words = "\n".join(words(self.scope))
        """All of it as a text, which other processes have too."""

    def _scope(self, function: FunctionType) -> dict[str, Any]:
        return {name: self._value(value, names_in(function)) for name, value in read_by(function).items()}

    def _value(self, value: Any, names: tuple[str, ...]) -> Any:
        if isinstance(value, wp.Function):
            return self._helper(value) if value.func else value
        if package_of(value) in KEPT:
            return value if ismodule(value) or callable(value) else deepcopy(value)
        if callable(value) and not isclass(value):
            return value
        if (key := (id(value), names)) not in self._made:
            made = self._made[key] = ModuleType("frozen")  # whose attributes Warp looks up
            for name in names:
                if hasattr(value, name):
                    setattr(made, name, self._value(getattr(value, name), names))
        return self._made[key]

    def _helper(self, helper: Any) -> Any:
        if id(helper) not in self._made:
            self._made[id(helper)] = helper  # where it calls itself
            forms = [*helper.user_overloads.values(), *helper.user_templates.values()]
            made = [self._copy(one) for one in forms if one.generic_parent is None]
            for one in made[1:]:
                made[0].add_overload(one)
            self._made[id(helper)] = made[0]
        return self._made[id(helper)]

    def _copy(self, helper: Any) -> Any:
        own = self._function(helper)
        snippets = {name: getattr(helper, name) for name in SNIPPETS}
        known = {"module": kernel_module("helpers"), "source": helper.adj.source, "inline_hint": helper.inline_hint}
        made = wp.Function(func=own, key=helper.key, namespace="", **known, **snippets, scope_locals={})
        for other, decorate in ((helper.custom_grad_func, wp.func_grad), (helper.custom_replay_func, wp.func_replay)):
            if other is not None:
                decorate(made)(self._function(other))
        self.helpers.append(made)
        return made

    def _function(self, helper: Any) -> FunctionType:
        """The function of Python, with a scope that is frozen."""
        function, what = helper.func, f"the function {helper.func.__name__} that {self._what} calls"
        check_bare(what, function)
        definition(what, function, helper.adj.source)
        code, scope = function.__code__, self._scope(function)
        cells = tuple(CellType(scope[name]) if name in scope else CellType() for name in code.co_freevars)
        made: Any = FunctionType(code, scope, function.__name__, function.__defaults__, cells)
        made.__annotations__, made.__module__ = dict(helper.adj.arg_types), function.__module__
        return made
