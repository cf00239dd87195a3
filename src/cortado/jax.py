"""Cortado as a layer of JAX: see `docs/layers.md`.

States are dictionaries of arrays by the names of their fields, in the simulation's precision, with their ``time`` [s];
parameters are dictionaries by the names that `Problem` has. All functions are differentiable in both modes, mapped by
`jax.vmap` as batches, and may stand within `jax.jit` and `jax.lax.scan`; second derivatives are refused. Within a
compiled program, where values are known only as it runs, JAX raises an error of its own with Cortado's sentence.
"""

from cortado.calls import face
from cortado.optimisation.layers import calls, loops
from cortado.optimisation.layers.calls import bound
from cortado.optimisation.layers.with_jax import JaxBridge

__all__ = ["measure", "picture", "restart_state", "rollout", "smoothed", "state", "step", "value"]

_BRIDGE = JaxBridge()
measure = bound(calls.measure, _BRIDGE, __name__)
picture = bound(calls.picture, _BRIDGE, __name__)
restart_state = bound(calls.restart_state, _BRIDGE, __name__)
rollout = bound(calls.rollout, _BRIDGE, __name__)
smoothed = bound(loops.smoothed, _BRIDGE, __name__)
state = bound(calls.state, _BRIDGE, __name__)
step = bound(calls.step, _BRIDGE, __name__)
value = bound(calls.value, _BRIDGE, __name__)

__dir__ = face(globals())
