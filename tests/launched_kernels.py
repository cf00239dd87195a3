"""Which kernels the steps and the steps back of problems launch."""

from unittest.mock import patch


def kernels_of_both_ways(cases) -> dict[str, list[str]]:
    """Their keys, of problems at points: of a run "forward", and "backward"."""
    from cortado.device.launching import KernelLauncher
    from cortado.rollout.rollout import Rollout

    seen: dict[str, set[str]] = {"forward": set(), "backward": set()}
    launch, back, way = KernelLauncher.__call__, Rollout.backward, ["forward"]

    def keep(self, kernel, *arguments, **options):
        seen[way[0]].add(kernel.key)
        launch(self, kernel, *arguments, **options)

    def backward(*arguments, **options):
        way[0] = "backward"
        found = back(*arguments, **options)
        way[0] = "forward"
        return found

    with patch.object(KernelLauncher, "__call__", keep), patch.object(Rollout, "backward", backward):
        for problem, point in cases:
            problem.value_and_gradient({**problem.simulation.parameters(), **point})
    return {name: sorted(keys) for name, keys in seen.items()}
