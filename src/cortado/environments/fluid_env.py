"""Gymnasium environments of one scene and of a batch of scenes. `Twin` is an episode as a differentiable function."""

import sys
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
from cortado.optimisation.transforms import FixedParameters, Transformed
from cortado.problem import Problem
from cortado.runs.sensor import Sensor
from cortado.runs.trajectory import Frame
from cortado.scene.parameter_values import Arrays


class Twin:
    """A differentiable function from the actions of an episode (actions, a) to minus the sum of its rewards. Actions
    are clipped to the range from -1 to 1, as in the environment. Clipped actions have the derivative 0."""

    def __init__(self, scenes: Scenes, number: int = 0, actions: int | None = None, state: EnvState | None = None):
        """Copy the current episode of scene ``number``, from its beginning or from a saved ``state``. ``actions`` is
        the number of actions, by default all remaining actions."""
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
        each = zip(task.actuators, begun, strict=True)
        self.coordinates = {one.parameter: one.over(count, m, task.time_step, now) for one, now in each}
        """Affine map from the actions of each actuator to its parameter, by parameter name."""
        loss = Frames({k * m: MinusReward(scenes.reward, start.goal[None], done + k) for k in range(1, count + 1)})
        self.problem = Problem(scenes.single, count * m, loss, state=restart)
        """The loss as a function of the scene's parameters."""
        fixed: Any = FixedParameters(self.problem, self._start) if self._start else self.problem
        self.search = Transformed(fixed, self.coordinates)
        """The loss as a function of the actions, for `cortado.optimise`. The actions are arrays by parameter name."""
        self.shape = count, sum(len(one.axes) for one in task.actuators)
        """Shape of the actions, (actions, a)."""

    def named(self, actions: Any) -> Arrays:
        """Split actions into arrays by parameter name."""
        parts = split(self._actuators, checked_actions("actions", actions, self.shape))
        return {one.parameter: u for one, u in zip(self._actuators, parts, strict=True)}

    def value(self, actions: Any) -> float:
        """Return minus the sum of the rewards."""
        return self.search.value(self.named(actions))

    def value_and_gradient(
        self, actions: Any, gradient: GradientEstimator | None = None
    ) -> tuple[float, NDArray[np.float64]]:
        """Return the loss and its gradient (actions, a). The default estimator is `gradients.Exact`."""
        value, found = self.search.value_and_gradient(self.named(actions), gradient)
        bar = np.concatenate([found[one.parameter] for one in self._actuators], axis=1)
        return value, np.where(np.abs(actions) <= 1.0, bar, 0.0)

    def in_jax(self, gradient: GradientEstimator | None = None) -> Any:
        """Return the loss as a differentiable function of a JAX array (actions, a). See `cortado.jax.value`."""
        from cortado.jax import value
        from cortado.optimisation.layers.with_jax import jnp

        loss, array = value(self.problem, gradient), jnp.asarray
        return lambda actions: self._loss(loss, array(actions), lambda a, u: array(a, u.dtype), jnp.tensordot)

    def in_torch(self, gradient: GradientEstimator | None = None) -> Any:
        """Return the loss as a differentiable function of a PyTorch tensor (actions, a). See `cortado.torch.value`."""
        from cortado.optimisation.layers.with_torch import torch
        from cortado.torch import value

        loss = value(self.problem, gradient)
        return lambda actions: self._loss(loss, actions, lambda numbers, u: u.new_tensor(numbers), torch.tensordot)

    def _loss(self, loss: Any, actions: Any, like: Any, tensordot: Any) -> Any:
        shape = getattr(actions, "shape", None)
        if shape is None or tuple(shape) != self.shape:
            found = f"is {shown(actions)}" if shape is None else f"has shape {tuple(shape)}"
            raise InputError(f"actions {found}, but must be an array of shape {self.shape}.")
        u, parameters, first = actions.clip(-1.0, 1.0), dict[str, Any](self._start), 0
        for one in self._actuators:
            last, affine = first + len(one.axes), self.coordinates[one.parameter]
            own = tensordot(like(affine.matrix, u), u[:, first:last], 2)
            parameters[one.parameter], first = like(affine.base, u) + own, last
        return loss(parameters)


try:
    import gymnasium
    from gymnasium.spaces import Box
    from gymnasium.utils.seeding import np_random
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    raise LibraryMissingError("Gymnasium", "gymnasium", "environments") from error

METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 30}
WIDTH, HEIGHT = 320, 200
Observation = NDArray[np.float32]
Info = dict[str, Any]


class FluidEnv(gymnasium.Env[Observation, NDArray]):
    """A Gymnasium environment of one scene: ``gymnasium.make("cortado/Carry-v0")``. See `docs/environments.md`."""

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
        """Make the environment of a task.

        Args:
            task: a name, such as "Carry", or a user-defined `Task`.
            size: "small", the default, or "large".
            device: "cpu", or "cuda:0" for the first GPU, as in `Simulation`.
            precision: "float32" or "float64".
            particles: number of observed particles.
            sensors: additional sensors to observe, by name; see `cortado.sensors`.
            render_mode: None or "rgb_array".
        """
        settings = size, device, precision, particles, sensors, render_mode
        self._envs = FluidVectorEnv(task, 1, *settings, AutoresetMode.DISABLED)
        self.scenes, self.render_mode, self._begun = self._envs.scenes, self._envs.render_mode, False
        self.observation_space, self._shape = self._envs.single_observation_space, self._envs._shape[1:]
        self.action_space = self._envs.single_action_space

    @property
    def layout(self) -> dict[str, slice]:
        """The slice of an observation that contains each observed quantity, by name."""
        return self.scenes.layout

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Observation, Info]:
        """Begin an episode. Equal seeds give bitwise equal episodes. With ``options={"state": state}`` the environment
        returns to a saved state, as with `restore`, and wrappers that count steps are reset. Raises `InputError` for
        unknown options."""
        if not self._envs.closed and (state := saved_option(options, seed)) is not None:
            return self.restore(state), {}
        super().reset(seed=None if seed is None else whole_number("seed", seed, 0))
        self._envs._generators = [self.np_random]
        self._envs._horizon = self.scenes.task.horizon if self.spec is None else sys.maxsize  # else a wrapper counts
        seen, info = self._envs.reset()
        self._begun = True
        return seen[0], info

    def step(self, action: NDArray) -> tuple[Observation, float, bool, bool, Info]:
        """Advance the episode by one action, which is clipped to the range from -1 to 1.

        An episode is truncated after the task's number of steps, or after ``max_episode_steps`` of `gymnasium.make`. If
        the simulation diverges, the episode is terminated, ``info["diverged"]`` describes the problem, and the step
        returns the previous observation.

        Raises `InputError` if the action has a wrong shape or is not finite, or if no episode is in progress.
        """
        if self._envs.closed or self._envs._over.any():
            when = "after the end of an episode" if self._begun else "before the first one"
            when = "after close()" if self._envs.closed else when
            raise InputError(f"step is called {when}, but must come after reset().")
        actions = checked_actions("action", action, self._shape)
        seen, rewards, lost, truncated, infos = self._envs.step(actions[None])
        info = {"diverged": infos["diverged"][0]} if lost[0] else {}
        return seen[0], float(rewards[0]), bool(lost[0]), bool(truncated[0]), info

    def close(self) -> None:
        """Close the environment. A closed environment begins no episode."""
        self._envs.close()

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture (rows, columns, 3) of the scene."""
        return pictures(self.scenes)[0] if self.render_mode else None

    def save(self) -> EnvState:
        """Return the state of the episode and of the random generator for `restore`. The saved state can be restored
        several times, also in different environments of the same task. Raises `InputError` before the first `reset`."""
        if not self._begun and not self._envs.closed:
            raise InputError("save is called before the first reset(), but must come after it.")
        return self._envs.save()

    def restore(self, state: EnvState) -> Observation:
        """Go back to a saved state, and return its observation. Raises `InputError` for a state of another task, batch
        or scene."""
        self._envs._generators = [self.np_random]
        seen: Observation = self._envs.restore(state)[0]
        self._begun, self._envs._horizon = True, self.scenes.task.horizon  # a wrapper does not know its step number
        return seen

    def twin(self, actions: int | None = None, state: EnvState | None = None) -> Twin:
        """Return a differentiable copy of the current episode, from its beginning or from a saved ``state``.
        ``actions`` is the number of actions, by default all remaining actions."""
        return Twin(self.scenes, 0, actions, state)


class FluidVectorEnv(VectorEnv):
    """A Gymnasium vector environment of a batch of scenes. The results are bitwise equal to single environments with
    the same seeds."""

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
        """Make a batch of ``num_envs`` scenes.

        ``autoreset_mode`` is the same as in `gymnasium.vector.SyncVectorEnv`. ``max_episode_steps`` is the number of
        steps of an episode before it is truncated, by default the task's horizon. See `FluidEnv` for other arguments.
        """
        self.num_envs, self.render_mode = whole_number("num_envs", num_envs, 1), render_mode
        if render_mode not in (None, *METADATA["render_modes"]):
            raise InputError(f'render_mode is {shown(render_mode)}, but must be None or "rgb_array".')
        try:
            self._mode = AutoresetMode(autoreset_mode)
        except ValueError:
            wanted = ", ".join(f'"{mode.value}"' for mode in AutoresetMode)
            raise InputError(f"autoreset_mode is {shown(autoreset_mode)}, but must be one of {wanted}.") from None
        self.scenes = Scenes(task_of(task, size), self.num_envs, device, precision, particles, sensors)
        self._observations = self.scenes.observed()
        actions = sum(len(one.axes) for one in self.scenes.task.actuators)
        self.single_observation_space = Box(-np.inf, np.inf, self._observations.shape[1:], np.float32)
        self.single_action_space, self._shape = Box(-1.0, 1.0, (actions,), np.float32), (num_envs, actions)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.metadata = {**METADATA, "autoreset_mode": self._mode}
        most = self.scenes.task.horizon if max_episode_steps is None else max_episode_steps
        self._horizon = whole_number("max_episode_steps", most, 1)
        self._generators: list[np.random.Generator] = [np_random()[0] for _ in range(num_envs)]
        self._over = np.ones(num_envs, dtype=bool)
        """Mask (num_envs,) of ended episodes."""

    @property
    def layout(self) -> dict[str, slice]:
        """The slice of an observation that contains each observed quantity, by name."""
        return self.scenes.layout

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        """Begin all episodes. With ``options={"reset_mask": mask}``, begin only the episodes where the bool array
        (num_envs,) is True. If ``seed`` is a number, environment b gets the seed ``seed + b``. With ``options={"state":
        state}`` the environments return to a saved state."""
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
                self._generators[b] = np_random(whole_number("seed", own, 0))[0]
        self._begin(mask)
        self._observations = np.where(mask[:, None], self.scenes.observed(), self._observations)
        return self._observations.copy(), {}

    def step(self, actions: NDArray) -> tuple[Observation, NDArray, NDArray, NDArray, Info]:
        """Advance all episodes by actions (num_envs, a), like `FluidEnv.step`.

        The autoreset mode decides when a new episode begins. In NEXT_STEP mode, the step after an ended episode ignores
        the action and begins a new episode. In SAME_STEP mode the episode begins at once, and the last observation and
        info are in ``infos["final_obs"]`` and ``infos["final_info"]``. In DISABLED mode only `reset` begins an episode.
        """
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
        self._observations = np.where(terminated[:, None], self._observations, self.scenes.observed())
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
            self._observations = np.where(over[:, None], self.scenes.observed(), self._observations)
        return self._observations.copy(), rewards, terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a picture (rows, columns, 3) of each scene."""
        return tuple(pictures(self.scenes)) if self.render_mode else None

    def save(self) -> EnvState:
        """Return the state of all episodes and random generators. Indexing selects episodes, such as ``state[[0, 0,
        2]]``."""
        self._require_open("save")
        random = [one.bit_generator.state for one in self._generators]
        return self.scenes.save(self._over, self._observations, random)

    def restore(self, state: EnvState) -> Observation:
        """Go back to a saved state, and return its observations. The state must have as many environments as the batch.
        See `FluidEnv.restore`."""
        self._require_open("restore")
        self.scenes.restore(state)
        for generator, own in zip(self._generators, state.generators, strict=True):
            generator.bit_generator.state = own
        self._over, self._observations = state.over.copy(), state.observations.copy()
        return self._observations.copy()

    def twin(self, number: int, actions: int | None = None, state: EnvState | None = None) -> Twin:
        """Return a differentiable copy of the episode of environment ``number``. See `FluidEnv.twin`."""
        return Twin(self.scenes, number, actions, state)

    def _require_open(self, what: str) -> None:
        if self.closed:
            raise InputError(f"{what} is called after close(), but must come before it.")

    def _begin(self, which: NDArray) -> dict[int, Start]:
        """Begin episodes where the mask ``which`` (num_envs,) is True. Return their first states."""
        starts = {b: self.scenes.drawn(self._generators[b]) for b in np.flatnonzero(which).tolist()}
        self.scenes.begin(starts)
        self._over = self._over & ~which
        return starts


def saved_option(options: Any, seed: Any, *others: str) -> EnvState | None:
    require_table("options", options or {}, "{'state': state}")
    found, known = options or {}, ("state", *others)
    for name in found:
        if name not in known:
            raise InputError(f"options has {shown(name)}, but may have {' or '.join(known)} only.")
    if "state" in found and (seed is not None or len(found) > 1):
        other = "seed" if seed is not None else others[0]
        raise InputError(f"{other} is given, but must be left out with a state.")
    return found.get("state")


def pictures(scenes: Scenes) -> list[NDArray[np.uint8]]:
    simulation, found = scenes.simulation, []
    fields = scenes.state.arrays.numpy(simulation.dimension)
    for b in range(len(scenes)):
        others = {name: array[b] for name, array in fields.items()}
        x, v, fractions = (others.pop(name) for name in ("positions", "velocities", "mass_fractions"))
        frame = Frame(x, v, fractions if len(simulation.scene.phase) > 1 else None, 0.0, others=others)
        found.append(to_srgb(simulation.picture(frame, width=WIDTH, height=HEIGHT)))
    return found
