"""Environments of Gymnasium: one, or many of one task in one launch, and the parts of Gymnasium that both need. Where
it is not installed, one sentence says so. `Twin` is an episode as a differentiable function of its actions.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.arrays import require_at_most, require_table, whole_number
from cortado.environments.catalogue import task_of
from cortado.environments.scenes import SEEN, EnvState, Scenes, Start
from cortado.environments.task import Task, checked_actions, split
from cortado.environments.terms import MinusReward
from cortado.errors import InputError, LibraryMissingError, shown
from cortado.files.image_encoding import to_srgb
from cortado.gradients import GradientEstimator
from cortado.losses import Frames
from cortado.optimisation.transforms import Affine, FixedParameters, Transformed
from cortado.problem import Problem
from cortado.runs.sensor import Sensor
from cortado.runs.trajectory import Frame
from cortado.scene.parameter_values import Arrays


class Twin:
    """A loss of actions (actions, a) for one episode, with its scene, start and goal: minus the sum of rewards. Actions
    beyond -1 to 1 are clipped, as in the environment, with derivative 0."""

    def __init__(self, scenes: Scenes, number: int = 0, actions: int | None = None, state: EnvState | None = None):
        """Copy the present episode of scene ``number`` from its start, or that of a saved ``state`` from there;
        ``actions``: how many, by default those that are left of a whole episode."""
        task, m = scenes.task, scenes.task.substeps
        require_at_most("number", whole_number("number", number, 0), len(scenes) - 1)
        done, begun, restart = 0, [one.at_rest(1) for one in task.actuators], None
        if state is not None:
            each: Any = scenes.simulation.on_host(scenes.taken(state))
            restart = each[number]
            done, begun = int(state.step_number[number]), [now[[number]] for now in state.driven]
        count = whole_number("actions", task.horizon - done if actions is None else actions, 1)
        require_at_most("actions", count, task.horizon - done)
        start = (scenes if state is None else state).starts[number]
        self._actuators = task.actuators
        self._start = {"initial_positions": start.positions} if state is None else {}
        self.coordinates = {
            one.parameter: one.over(count, m, task.time_step, now)
            for one, now in zip(task.actuators, begun, strict=True)
        }
        """From the actions of each actuator to the parameter that it drives."""
        goal = start.goal[None]
        loss = Frames({k * m: MinusReward(scenes.reward, goal, done + k) for k in range(1, count + 1)})
        self.problem = Problem(scenes.single, count * m, loss, state=restart)
        """The loss as one of the parameters of the scene."""
        fixed: Any = FixedParameters(self.problem, self._start) if self._start else self.problem
        self.search = Transformed(fixed, self.coordinates)
        """The loss as one of the actions, named by `named`: what `cortado.optimise` takes."""
        self.shape = count, sum(len(one.axes) for one in task.actuators)
        """(actions, a)"""

    def named(self, actions: Any) -> Arrays:
        """Return actions by the names of the parameters that they drive."""
        parts = split(self._actuators, checked_actions("actions", actions, self.shape))
        return {one.parameter: u for one, u in zip(self._actuators, parts, strict=True)}

    def value(self, actions: Any) -> float:
        """Return the loss of some actions: minus the sum of rewards."""
        return self.search.value(self.named(actions))

    def value_and_gradient(
        self, actions: Any, gradient: GradientEstimator | None = None
    ) -> tuple[float, NDArray[np.float64]]:
        """Return the loss and its derivative (actions, a), by any estimator, `gradients.Exact` by default."""
        value, found = self.search.value_and_gradient(self.named(actions), gradient)
        bar = np.concatenate([found[one.parameter] for one in self._actuators], axis=1)
        return value, np.where(np.abs(actions) <= 1.0, bar, 0.0)

    def in_jax(self, gradient: GradientEstimator | None = None) -> Any:
        """Return the loss as a function of a JAX array (actions, a), differentiable there: see `cortado.jax.value`."""
        from cortado.jax import value
        from cortado.optimisation.layers.with_jax import jnp

        def contracted(one: Affine, u: Any) -> Any:
            return jnp.asarray(one.base, u.dtype) + jnp.tensordot(jnp.asarray(one.matrix, u.dtype), u, 2)

        loss = value(self.problem, gradient)
        return lambda actions: loss(self._parameters(self._shaped(jnp.asarray(actions)).clip(-1.0, 1.0), contracted))

    def in_torch(self, gradient: GradientEstimator | None = None) -> Any:
        """Return the loss as a function of a PyTorch tensor (actions, a): see `cortado.torch.value`."""
        from cortado.optimisation.layers.with_torch import torch
        from cortado.torch import value

        def contracted(one: Affine, u: Any) -> Any:
            return u.new_tensor(one.base) + torch.tensordot(u.new_tensor(one.matrix), u, 2)

        loss = value(self.problem, gradient)
        return lambda actions: loss(self._parameters(self._shaped(actions).clamp(-1.0, 1.0), contracted))

    def _shaped(self, actions: Any) -> Any:
        """Return actions of another library unchanged; raises `InputError` for another shape."""
        shape = getattr(actions, "shape", None)
        if shape is None or tuple(shape) != self.shape:
            found = f"is {shown(actions)}" if shape is None else f"has shape {tuple(shape)}"
            raise InputError(f"actions {found}, but must be an array {self.shape}.")
        return actions

    def _parameters(self, u: Any, contracted: Any) -> dict[str, Any]:
        """Return the scene's parameters under actions of another library, whose product is ``contracted``."""
        found, first = dict[str, Any](self._start), 0
        for one in self._actuators:
            last = first + len(one.axes)
            found[one.parameter] = contracted(self.coordinates[one.parameter], u[:, first:last])
            first = last
        return found


try:
    import gymnasium
    from gymnasium.utils.seeding import np_random
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    raise LibraryMissingError("Gymnasium", "gymnasium", "environments") from error

METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 30}
WIDTH, HEIGHT = 320, 200
"""Of pictures."""
BEFORE = "before the first one"
"""When a step is refused: no episode has begun."""
Observation = NDArray[np.float32]
Info = dict[str, Any]


class FluidEnv(gymnasium.Env[Observation, NDArray]):
    """A Gymnasium environment of one scene, as `gymnasium.make("cortado/Carry-v0")` makes; see
    `docs/environments.md`."""

    metadata = METADATA

    def __init__(
        self,
        task: str | Task,
        size: str | None = None,
        device: str = "cpu",
        precision: str = "float32",
        particles: int = SEEN,
        sensors: Mapping[str, Sensor] | None = None,
        render_mode: str | None = None,
    ):
        """Make the environment of a ``task``: its name, such as "Carry", in the ``size`` "small", if left out, or
        "large"; or a `Task` of your own. ``particles``: how many are observed; ``sensors`` by name, such as those of
        `cortado.sensors`, are observed as well; ``device`` and ``precision`` as those of `Simulation`; ``render_mode``
        None or "rgb_array"."""
        self.render_mode = checked_render_mode(render_mode)
        self.scenes = Scenes(task_of(task, size), 1, device, precision, particles, sensors)
        self.observation_space, actions = spaces(self.scenes)
        self.action_space, self._shape = actions, actions.shape
        self._over, self._counts = BEFORE, False
        """Why no step is possible, if so; and whether the environment itself counts how long an episode may be, as
        Gymnasium's wrapper cannot know how far a restored one was."""
        self._closed = False

    @property
    def layout(self) -> dict[str, slice]:
        """Slices of an observation by the name of its parts."""
        return self.scenes.layout

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Observation, Info]:
        """Begin an episode; equal seeds give equal bits. ``options={"state": state}`` goes back to a saved state, as
        `restore` does, through wrappers that count steps. Raises `InputError` for other options."""
        self._require_open("reset")
        if (state := saved_option(options, seed)) is not None:
            return self.restore(state), {}
        super().reset(seed=seed)
        self._counts = self.spec is None
        self.scenes.begin({0: self.scenes.drawn(self.np_random)})
        self._over = ""
        self._observation = self.scenes.observed()[0]
        return self._observation.copy(), {}

    def step(self, action: NDArray) -> tuple[Observation, float, bool, bool, Info]:
        """Advance the episode by one action, clipped to -1 to 1. An episode is truncated after as many steps as its
        task has, or as `gymnasium.make` was given as ``max_episode_steps``. Where the simulation diverges, the episode
        is terminated, ``info["diverged"]`` says how in a sentence, and the observation is the last one before.

        Raises `InputError` for an action of another shape or that is not finite, and where no episode is going on."""
        if self._over:
            raise InputError(f"step is called {self._over}, but must come after reset().")
        actions = checked_actions("action", action, self._shape)
        rewards, lost = self.scenes.step(actions[None])
        if not lost:
            self._observation = self.scenes.observed()[0]
        truncated = not lost and self._counts and bool(self.scenes.step_number[0] >= self.scenes.task.horizon)
        self._over = "after the end of an episode" if lost or truncated else ""
        info = {"diverged": lost[0]} if lost else {}
        return self._observation.copy(), float(rewards[0]), bool(lost), truncated, info

    def close(self) -> None:
        """End the episode for good: no other may begin."""
        self._closed, self._over = True, "after close()"

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture (rows, columns, 3) of the scene."""
        return pictures(self.scenes)[0] if self.render_mode else None

    def save(self) -> EnvState:
        """Return where the episode is, with the random generator, for `restore`: any number of times, and in other
        environments of the same task. Raises `InputError` before the first `reset`."""
        self._require_open("save")
        if self._over == BEFORE:
            raise InputError("save is called before the first reset(), but must come after it.")
        random = self.np_random.bit_generator.state
        return self.scenes.save(np.array([bool(self._over)]), self._observation[None], [random])

    def restore(self, state: EnvState) -> Observation:
        """Go back to a saved state, and return its observation. Raises `InputError` for a state of another task, batch
        or scene."""
        self._require_open("restore")
        self.scenes.restore(state)
        self.np_random.bit_generator.state = state.generators[0]
        self._over, self._counts = "after the end of an episode" if state.over[0] else "", True
        self._observation = state.observations[0].copy()
        return self._observation.copy()

    def twin(self, actions: int | None = None, state: EnvState | None = None) -> Twin:
        """Return a differentiable copy of the present episode from its start, or of that of a saved ``state`` from
        there, of so many ``actions``, by default all that are left."""
        return Twin(self.scenes, 0, actions, state)

    def _require_open(self, what: str) -> None:
        if self._closed:
            raise InputError(f"{what} is called after close(), but must come before it.")


class FluidVectorEnv(VectorEnv):
    """A Gymnasium vector environment: a batch of scenes, each with the bits of the single one with its seed."""

    def __init__(
        self,
        task: str | Task,
        num_envs: int = 1,
        size: str | None = None,
        device: str = "cpu",
        precision: str = "float32",
        particles: int = SEEN,
        sensors: Mapping[str, Sensor] | None = None,
        render_mode: str | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
    ):
        """Make a batch of ``num_envs`` scenes; ``autoreset_mode`` as that of `gymnasium.vector.SyncVectorEnv`;
        ``max_episode_steps``: after how many steps an episode is truncated, by default the horizon of the task. Other
        arguments are those of `FluidEnv`."""
        self.num_envs, self.render_mode = whole_number("num_envs", num_envs, 1), checked_render_mode(render_mode)
        try:
            self._mode = AutoresetMode(autoreset_mode)
        except ValueError:
            wanted = ", ".join(f'"{mode.value}"' for mode in AutoresetMode)
            raise InputError(f"autoreset_mode is {shown(autoreset_mode)}, but must be one of {wanted}.") from None
        self.scenes = Scenes(task_of(task, size), self.num_envs, device, precision, particles, sensors)
        self.single_observation_space, actions = spaces(self.scenes)
        self.single_action_space, self._shape = actions, (num_envs, *actions.shape)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.metadata = {**METADATA, "autoreset_mode": self._mode}
        most = self.scenes.task.horizon if max_episode_steps is None else max_episode_steps
        self._horizon = whole_number("max_episode_steps", most, 1)
        self._generators: list[np.random.Generator] = [np_random()[0] for _ in range(num_envs)]
        self._over = np.ones(num_envs, dtype=bool)
        """(num_envs,) whose episodes are over."""
        self._observations = self.scenes.observed()

    @property
    def layout(self) -> dict[str, slice]:
        """Slices of an observation by the name of its parts."""
        return self.scenes.layout

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        """Begin all episodes, or those that ``options={"reset_mask": (num_envs,) bool}`` chooses. A number as ``seed``
        gives environment b the seed + b. ``options={"state": state}`` goes back to a saved state, as `restore` does."""
        self._require_open("reset")
        if (state := saved_option(options, seed, "reset_mask")) is not None:
            return self.restore(state), {}
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool))
        if not isinstance(mask, np.ndarray) or mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            wanted = f"an array ({self.num_envs},) of bool that is not False throughout"
            raise InputError(f"reset_mask is {shown(mask)}, but must be {wanted}.")
        if seed is None or isinstance(seed, (int, np.integer)):
            seeds = [None if seed is None else int(seed) + b for b in range(self.num_envs)]
        elif isinstance(seed, (list, tuple, np.ndarray)):
            seeds = list(seed)
        else:
            raise InputError(f"seed is {shown(seed)}, but must be a whole number, or a list of them.")
        if len(seeds) != self.num_envs:
            raise InputError(f"seed has {len(seeds)} numbers, but must have {self.num_envs}, one for each environment.")
        for b, own in enumerate(seeds):
            if mask[b] and own is not None:
                self._generators[b] = np_random(own)[0]
        self._begin(mask)
        self._observe(mask)
        return self._observations.copy(), {}

    def step(self, actions: NDArray) -> tuple[Observation, NDArray, NDArray, NDArray, Info]:
        """Advance all episodes by actions (num_envs, a); see `FluidEnv.step`. An episode that is over begins anew as
        the autoreset mode says. It does so in the next step, in the place of its action; in the same step, with what it
        ended with in ``infos["final_obs"]`` and ``infos["final_info"]``; or only by `reset`."""
        self._require_open("step")
        actions = checked_actions("actions", actions, self._shape)
        if self._over.any() and self._mode is not AutoresetMode.NEXT_STEP:
            found = f"step is called after the end of the episode of environment {self._over.argmax()}"
            raise InputError(f"{found}, but must come after reset().")
        anew, rewards, lost = self._over, np.zeros(self.num_envs), dict[int, str]()
        begun = self._begin(anew)
        if not anew.all():
            rewards, lost = self.scenes.step(np.where(anew[:, None], 0.0, actions))
            lost = {b: sentence for b, sentence in lost.items() if not anew[b]}
            rewards[anew] = 0.0
            self.scenes.begin(begun)  # these do not take this step
        terminated = np.isin(np.arange(self.num_envs), list(lost))
        self._observe(~terminated)
        truncated = ~terminated & (self.scenes.step_number >= self._horizon)
        self._over, infos = terminated | truncated, Info()
        for b, sentence in lost.items():
            infos = self._add_info(infos, {"diverged": sentence}, b)
        if self._mode is AutoresetMode.SAME_STEP and self._over.any():
            over = self._over
            for b in np.flatnonzero(over).tolist():
                final = {"diverged": lost[b]} if b in lost else {}
                infos = self._add_info(infos, {"final_obs": self._observations[b], "final_info": final}, b)
            self._begin(over)
            self._observe(over)
        return self._observations.copy(), rewards, terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a picture (rows, columns, 3) of each scene."""
        return tuple(pictures(self.scenes)) if self.render_mode else None

    def save(self) -> EnvState:
        """Return where all episodes are, with the random generators; see `FluidEnv.save`. Some of them, in any order,
        are ``state[[0, 0, 2]]``."""
        self._require_open("save")
        random = [one.bit_generator.state for one in self._generators]
        return self.scenes.save(self._over, self._observations, random)

    def restore(self, state: EnvState) -> Observation:
        """Go back to a saved state of as many environments, and return its observations; see `FluidEnv.restore`."""
        self._require_open("restore")
        self.scenes.restore(state)
        for generator, own in zip(self._generators, state.generators, strict=True):
            generator.bit_generator.state = own
        self._over, self._observations = state.over.copy(), state.observations.copy()
        return self._observations.copy()

    def twin(self, number: int, actions: int | None = None, state: EnvState | None = None) -> Twin:
        """Return a differentiable copy of the episode of one environment; see `FluidEnv.twin`."""
        return Twin(self.scenes, number, actions, state)

    def _require_open(self, what: str) -> None:
        if self.closed:
            raise InputError(f"{what} is called after close(), but must come before it.")

    def _begin(self, which: NDArray) -> dict[int, Start]:
        """Begin new episodes in the environments that a mask (num_envs,) chooses, and return their starts."""
        starts = {b: self.scenes.drawn(self._generators[b]) for b in np.flatnonzero(which).tolist()}
        self.scenes.begin(starts)
        self._over = self._over & ~which
        return starts

    def _observe(self, which: NDArray) -> None:
        """Observe the environments that a mask (num_envs,) chooses; others keep their last observation."""
        self._observations = np.where(which[:, None], self.scenes.observed(), self._observations)


def spaces(scenes: Scenes) -> tuple[Any, Any]:
    """Return the Gymnasium spaces of one environment's observations and actions."""
    seen = scenes.observed().shape[1]
    actions = sum(len(one.axes) for one in scenes.task.actuators)
    everything = gymnasium.spaces.Box(-np.inf, np.inf, (seen,), np.float32)
    return everything, gymnasium.spaces.Box(-1.0, 1.0, (actions,), np.float32)


def checked_render_mode(mode: str | None) -> str | None:
    """Return a render mode; raises `InputError` unless it is None or "rgb_array"."""
    if mode not in (None, *METADATA["render_modes"]):
        raise InputError(f'render_mode is {shown(mode)}, but must be None or "rgb_array".')
    return mode


def saved_option(options: Any, seed: Any, *others: str) -> EnvState | None:
    """Return the state among the options of a reset, if any. Raises `InputError` for options that are no table, that
    have unknown names, and for a state beside anything else."""
    require_table("options", options or {}, "{'state': state}")
    found, known = options or {}, ("state", *others)
    for name in found:
        if name not in known:
            raise InputError(f"options has {shown(name)}, but must have {' or '.join(known)} alone.")
    if "state" in found and (seed is not None or len(found) > 1):
        other = "seed" if seed is not None else others[0]
        raise InputError(f"{other} is given, but must be left out beside a state, which has all that is drawn.")
    return found.get("state")


def pictures(scenes: Scenes) -> list[NDArray[np.uint8]]:
    """Render a picture (HEIGHT, WIDTH, 3) of each scene."""
    simulation, found = scenes.simulation, []
    fields = scenes.state.arrays.numpy(simulation.dimension)
    own = ("positions", "velocities", "mass_fractions")
    for b in range(len(scenes)):
        others = {name: array[b] for name, array in fields.items() if name not in own}
        fractions = fields["mass_fractions"][b] if len(simulation.scene.phase) > 1 else None
        frame = Frame(fields["positions"][b], fields["velocities"][b], fractions, 0.0, others=others)
        found.append(to_srgb(simulation.picture(frame, width=WIDTH, height=HEIGHT)))
    return found
