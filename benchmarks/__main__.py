"""``python -m benchmarks bench``: a dam break, timed."""

from functools import partial
from typing import Literal

from tyro.extras import SubcommandApp

from benchmarks.bench.timing import MOST_REPEATS
from cortado.arrays import require_at_most
from cortado.cli.arguments import Flag, Program, Work, command, require_at_least
from cortado.cli.process import main

app = SubcommandApp()
BENCH = Program("python -m benchmarks", app, "Times Cortado on this machine.")


@command(app, answers=True)
def bench(
    particles: tuple[int, ...] = (8000,),
    steps: int = 20,
    repeats: int = 5,
    device: str = "cpu",
    precision: str = "float32",
    solver: Literal["projection", "pcisph"] = "projection",
    engine: Literal["warp", "reference"] = "warp",
    json: Flag = False,
) -> Work:
    """Time a dam break: each pass of a step, the step, a rollout and its gradient, beside what the hardware allows.

    Args:
        particles: Numbers of fluid particles, about; one measurement for each.
        steps: Number of time steps.
        repeats: The median of so many repeats counts.
        device: "cpu", or "cuda:0" for the first GPU.
        precision: "float32" or "float64"; of the reference engine also "float80" and "float128".
        solver: The projection as scenes have it, or PCISPH with 5 iterations a step.
        engine: The one in Warp, or the reference engine in C++, which is timed with PCISPH.
        json: Print JSON for machines, with more numbers, instead of tables.
    """
    require_at_least(1, len(particles), "the number of --particles")
    require_at_least(1, min(particles), "--particles")
    require_at_least(1, repeats, "--repeats")
    require_at_most("--repeats", repeats, MOST_REPEATS)
    from benchmarks.bench.run import bench_dam_break, bench_reference

    if engine == "reference":
        return partial(bench_reference, particles, steps, repeats, precision, json)
    else:
        return partial(bench_dam_break, particles, steps, repeats, device, precision, solver, json)


@command(app, answers=True)
def environments(
    task: str = "Carry",
    scenes: int = 256,
    size: Literal["small", "large"] = "large",
    steps: int = 20,
    device: str = "cpu",
    precision: str = "float32",
    json: Flag = False,
) -> Work:
    """Time steps of a batch of environments under random actions, beside those of the simulation alone.

    Args:
        task: Such as "Carry".
        scenes: Environments in the batch.
        size: "small", with about 100 particles each, or "large", with about 1,000.
        steps: Steps of the environments that are timed; their median counts.
        device: "cpu", or "cuda:0" for the first GPU.
        precision: "float32" or "float64".
        json: Print JSON for machines instead of a sentence.
    """
    require_at_least(1, steps, "--steps")
    from benchmarks.bench.learning import bench_environments

    return partial(bench_environments, task, scenes, size, steps, device, precision, json)


@command(app, answers=True)
def learners(
    task: tuple[str, ...] = ("Carry", "Latte", "Pour", "Raft", "Splash", "Stir"),
    episodes: int = 320,
    seed: int = 1,
    size: Literal["small", "large"] = "small",
    device: str = "cpu",
    policies: Flag = False,
    json: Flag = False,
) -> Work:
    """Compare a cross-entropy method, gradients and PPO by the return of an episode, on the same simulated steps.

    Args:
        task: Such as "Carry"; several, one behind the other.
        episodes: The budget in whole episodes; one with its gradient counts as four.
        seed: The one of the episode, and of random numbers.
        size: "small", with about 100 particles each, or "large", with about 1,000.
        device: "cpu", or "cuda:0" for the first GPU.
        policies: PPO as well, for which Stable-Baselines3 has to be installed.
        json: Print JSON for machines instead of a table.
    """
    require_at_least(16, episodes, "--episodes")
    from benchmarks.bench.learners import bench_learners

    return partial(bench_learners, task, episodes, seed, size, device, policies, json)


@command(app, answers=True)
def watching(depth: int = 20, steps: int = 200, repeats: int = 3, device: str = "cpu", json: Flag = False) -> Work:
    """Time runs with sensors and frames, and steps one by one, beside the same steps alone.

    Args:
        depth: Spacings in the depth of a tank in the plane, with 3.4 times its square of particles.
        steps: Steps of a run.
        repeats: The least of so many repeats counts.
        device: "cpu", or "cuda:0" for the first GPU.
        json: Print JSON for machines instead of a table.
    """
    require_at_least(4, depth, "--depth")
    require_at_least(1, steps, "--steps")
    require_at_least(1, repeats, "--repeats")
    from benchmarks.bench.watching import bench_watching

    return partial(bench_watching, depth, steps, repeats, device, json)


@command(app, answers=True)
def loops(side: int = 15, steps: int = 20, repeats: int = 40, device: str = "cpu", json: Flag = False) -> Work:
    """Time loops of JAX in which a policy acts in every step, beside one call of as many steps.

    Args:
        side: Spacings in the side of a square of fluid in the plane, with its square of particles.
        steps: Steps of a loop.
        repeats: The least of so many repeats counts.
        device: "cpu", or "cuda:0" for the first GPU.
        json: Print JSON for machines instead of a table.
    """
    require_at_least(4, side, "--side")
    require_at_least(1, steps, "--steps")
    require_at_least(1, repeats, "--repeats")
    from benchmarks.bench.loops import bench_loops

    return partial(bench_loops, side, steps, repeats, device, json)


@command(app, answers=True)
def probed(
    depth: int = 11,
    steps: int = 32,
    every: tuple[int, ...] = (1, 2, 4, 8, 16),
    repeats: int = 3,
    device: str = "cpu",
    precision: str = "float32",
    json: Flag = False,
) -> Work:
    """Time losses of a pressure probe in some states of a run, beside a loss of its end.

    Args:
        depth: Spacings in the depth of a tank in the plane, with 3.4 times its square of particles.
        steps: Steps of the run.
        every: A loss in every so many states; one measurement for each.
        repeats: The least of so many repeats counts.
        device: "cpu", or "cuda:0" for the first GPU.
        precision: "float32" or "float64".
        json: Print JSON for machines instead of a table.
    """
    require_at_least(4, depth, "--depth")
    require_at_least(1, min(every), "--every")
    require_at_least(1 + max(every), steps, "--steps")
    require_at_least(1, repeats, "--repeats")
    from benchmarks.bench.probed import bench_probed

    return partial(bench_probed, depth, steps, every, repeats, device, precision, json)


@command(app, answers=True)
def estimating(
    depth: int = 7, particles: int = 8000, steps: int = 10, repeats: int = 3, device: str = "cpu", json: Flag = False
) -> Work:
    """Time gradients by estimators that go back through one run, beside the exact one.

    Args:
        depth: Spacings in the depth of a tank in the plane, with 3.4 times its square of particles.
        particles: Number of particles of a dam break in space, about.
        steps: Steps of a run.
        repeats: The least of so many repeats counts.
        device: "cpu", or "cuda:0" for the first GPU.
        json: Print JSON for machines instead of a table.
    """
    require_at_least(4, depth, "--depth")
    require_at_least(8, particles, "--particles")
    require_at_least(1, steps, "--steps")
    require_at_least(1, repeats, "--repeats")
    from benchmarks.bench.estimating import bench_estimating

    return partial(bench_estimating, depth, particles, steps, repeats, device, json)


@command(app, answers=True)
def batches(
    scenes: tuple[int, ...] = (1, 256), steps: int = 100, repeats: int = 3, device: str = "cpu", json: Flag = False
) -> Work:
    """Time batches of dam breaks of 125 particles, forward and with the gradient.

    Args:
        scenes: Numbers of scenes in a batch; one measurement for each, compared with the first.
        steps: Number of time steps.
        repeats: The median of so many repeats counts.
        device: "cpu", or "cuda:0" for the first GPU.
        json: Print JSON for machines instead of text.
    """
    require_at_least(1, len(scenes), "the number of --scenes")
    require_at_least(1, min(scenes), "--scenes")
    require_at_least(1, steps, "--steps")
    require_at_least(1, repeats, "--repeats")
    from benchmarks.bench.batches import bench_batches

    return partial(bench_batches, scenes, steps, repeats, device, json)


@command(app, answers=True)
def pictures(
    particles: tuple[int, ...] = (8000, 100_000),
    lines: int = 1080,
    repeats: int = 5,
    device: str = "cpu",
    json: Flag = False,
) -> Work:
    """Time pictures of a broken dam, and compare those of a GPU with what the CPU draws.

    Args:
        particles: Numbers of fluid particles, about; one measurement for each.
        lines: Rows of pixels; a picture is 16 : 9.
        repeats: The median of so many repeats counts.
        device: "cpu", or "cuda:0" for the first GPU.
        json: Print JSON for machines instead of text.
    """
    require_at_least(1, len(particles), "the number of --particles")
    require_at_least(8, min(particles), "--particles")
    require_at_least(64, lines, "--lines")
    require_at_least(1, repeats, "--repeats")
    from benchmarks.bench.pictures import bench_pictures

    return partial(bench_pictures, particles, lines, repeats, device, json)


if __name__ == "__main__":
    main(program=BENCH)
