"""Cortado as a layer of JAX. `docs/layers.md` has examples.

States are dictionaries of arrays by field name, with the ``time`` [s]. Parameters have names as in `Problem`.

All functions are differentiable in forward and reverse mode, run as batches under `jax.vmap`, and work inside `jax.jit`
and `jax.lax.scan`. Second derivatives raise an error. In compiled programs, JAX's error contains Cortado's message.
"""

from cortado.calls import face
from cortado.optimisation.layers import user_functions
from cortado.optimisation.layers.user_functions import bound
from cortado.optimisation.layers.with_jax import JaxBridge

__all__ = ["measure", "picture", "restart_state", "rollout", "smoothed", "state", "step", "value"]

_BRIDGE = JaxBridge()
measure = bound(user_functions.measure, _BRIDGE, __name__)
picture = bound(user_functions.picture, _BRIDGE, __name__)
restart_state = bound(user_functions.restart_state, _BRIDGE, __name__)
rollout = bound(user_functions.rollout, _BRIDGE, __name__)
smoothed = bound(user_functions.smoothed, _BRIDGE, __name__)
state = bound(user_functions.state, _BRIDGE, __name__)
step = bound(user_functions.step, _BRIDGE, __name__)
value = bound(user_functions.value, _BRIDGE, __name__)

__dir__ = face(globals())
