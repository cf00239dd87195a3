"""``cortado`` alone: what one can do, each with an example."""

from cortado.version import __version__

_GROUPS = {
    "Begin": (
        ("cortado new dam.toml", "write a commented scene that runs at once"),
        ("cortado describe dam.toml", "particles, memory, time, what limits its time step"),
        ("cortado run dam.toml --out runs/dam", "run it; open runs/dam/report.html"),
        ("cortado picture runs/dam", "a shaded picture of it; --film for a film"),
        ("cortado export runs/dam --to usd", "for Blender, Houdini; --to vtp for ParaView"),
        ("cortado view runs/dam", "play it in the browser; a scene runs there, live"),
        ("cortado examples", "list the examples; --copy NAME brings one here"),
    ),
    "Go on": (
        ("cortado run dam.toml --out runs/fine --set discretisation.spacing=0.02", "replace a value"),
        ("cortado compare runs/dam runs/fine", "two runs: the same scene? how far apart?"),
        ("cortado optimise task.toml --out runs/found", "find what a task file asks for; --resume goes on"),
        ("cortado fit task.toml --out runs/fit", "a viscosity with an error bar, from a video or a force"),
        ("cortado sweep dam.toml --set phase.0.viscosity=0.05,0.1", "every combination of some values"),
        ("cortado picture runs/sweep --film", "its runs side by side"),
        ("cortado convergence runs/sweep", "of several spacings: the order, the limit"),
        ("cortado dataset dam.toml --runs 100 --out data", "varied runs to train on, as LagrangeBench's"),
        ("cortado gradients check dam.toml --steps 20", "are gradients right, and for how long?"),
    ),
    "Set up": (
        ("cortado schema", "the JSON schema of scenes, for editors"),
        ("cortado completion bash", "completion of commands and options by the shell"),
    ),
}
COMMANDS = [command for group in _GROUPS.values() for command, _ in group]
"""Every example, as one would type it."""


def overview() -> str:
    """As text."""
    lines = [f"Cortado {__version__}, a differentiable SPH fluid simulator."]
    for title, entries in _GROUPS.items():
        lines += ["", f"{title}:"]
        for command, meaning in entries:
            lines += (
                [f"  {command:<41}  {meaning}"] if len(command) <= 41 else [f"  {command}", f"  {'':<41}  {meaning}"]
            )
    lines += ["", "Every command has --help, and --quiet for no more than results, warnings and errors."]
    return "\n".join(lines)
