"""``python -m experiments study``: all experiments of a folder, one after the other."""

from pathlib import Path

from cortado.errors import ComputationError, CortadoError, InputError
from cortado.files.terminal import note, tell
from experiments.experiment import DeviceSettings, Experiment
from experiments.experiment_files import load_experiment
from experiments.results import Results


def run_study(folder: Path, out: Path, reduced: bool, only: list[str]) -> str:
    """Measure what is not there yet; returns the verdicts and a line that says where everything is."""
    files = _chosen(folder, only)
    experiments = [load_experiment(file, reduced) for file in files]
    sections, failures = [], []
    for experiment in experiments:
        results = Results(out / experiment.name)
        try:
            verdict = _verdict(experiment, results)
        except CortadoError as error:
            verdict = [f"Failed: {error}"]
            failures.append(experiment.name)
        sections.append("\n".join([f"{experiment.name}: {experiment.settings.title}", *(f"  {s}" for s in verdict)]))
    if failures:
        tell("\n\n".join(sections))
        raise ComputationError(f"These experiments failed: {', '.join(failures)}. The others are in {out.absolute()}.")
    return "\n\n".join([*sections, f"The results are in {out.absolute()}, a folder for each experiment."])


def _chosen(folder: Path, only: list[str]) -> list[Path]:
    files = {file.stem: file for file in sorted(folder.glob("*.toml"))}
    if not files:
        raise InputError(f"{folder} holds no experiments, but must be a folder with TOML files of them.")
    for name in only:
        if name not in files:
            raise InputError(f"--only is {name!r}, but must be one of {', '.join(files)}.")
    return [file for name, file in files.items() if name in only or not only]


def _verdict(experiment: Experiment, results: Results) -> list[str]:
    if results.has(experiment):
        return results.verdict()
    if _needs_gpu(experiment) and not _has_gpu():
        return ["Left out: it needs a GPU, and there is none."]
    note(f"{experiment.name} ...")
    return results.measure(experiment)


def _needs_gpu(experiment: Experiment) -> bool:
    settings = experiment.settings
    return isinstance(settings, DeviceSettings) and settings.device.startswith("cuda")


def _has_gpu() -> bool:
    import warp as wp

    return wp.get_cuda_device_count() > 0
