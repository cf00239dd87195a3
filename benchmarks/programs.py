"""Programs that benchmarks run, each in a process of its own, so that none keeps memory or threads from the others."""

import json
import resource
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.bench.environment import OtherProcesses

PEERS = Path(__file__).parent / "peers"


class ProgramError(Exception):
    """A program ended badly; the message is the last that it said."""


@dataclass(frozen=True)
class Program:
    """Something to be timed, with the interpreter that has it."""

    name: str
    python: str
    words: tuple[str, ...]
    """What comes after the interpreter, before the numbers of particles and steps."""
    module: str
    """The package that it needs."""

    @property
    def is_installed(self) -> bool:
        """Whether the interpreter has the package."""
        return subprocess.run([self.python, "-c", f"import {self.module}"], capture_output=True).returncode == 0

    def run(self, particles: int, steps: int, repeats: int, timeout: float, environment: dict[str, str]) -> Any:
        """What it measures, read from the JSON that it prints, and how busy the machine was meanwhile; raises
        `ProgramError`."""
        numbers = {"--particles": particles, "--steps": steps, "--repeats": repeats}
        options = [word for name, value in numbers.items() for word in (name, str(value))]
        others = OtherProcesses(seconds_of_children)
        found = last_json([self.python, *self.words, *options, "--json"], timeout, environment)
        return {**found, "cores_busy_elsewhere": others.busy_cores()}


def seconds_of_children() -> float:
    """Processor time of the programs that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def last_json(command: Sequence[str], timeout: float, environment: dict[str, str]) -> Any:
    """The JSON at the end of what a command prints, whatever libraries print before it; raises `ProgramError`."""
    try:
        found = subprocess.run(command, capture_output=True, text=True, timeout=timeout, env=environment)
    except subprocess.TimeoutExpired:
        raise ProgramError(f"not done within {timeout:g} s") from None
    lines = found.stdout.splitlines()
    if found.returncode:
        said = (found.stderr or found.stdout).strip().splitlines()
        raise ProgramError(said[-1][:300] if said else f"exit code {found.returncode}")
    start = max(number for number, line in enumerate(lines) if line.startswith("{"))
    return json.loads("\n".join(lines[start:]))


def cortado(device: str, precision: str) -> list[Program]:
    """``python -m benchmarks bench`` with each of Cortado's solvers."""
    words = ("-m", "benchmarks", "bench", "--device", device, "--precision", precision, "--solver")
    solvers = {"projection": "Cortado, projection", "pcisph": "Cortado, PCISPH"}
    return [Program(name, sys.executable, (*words, solver), "cortado") for solver, name in solvers.items()]


def peers(device: str, jax_python: str, splishsplash_python: str) -> list[Program]:
    """What Cortado is compared with on a device."""
    found = [Program("PCISPH in JAX", jax_python, (str(PEERS / "jax_pcisph.py"),), "jax")]
    if device == "cpu":
        for method in ("PCISPH", "DFSPH"):
            words = (str(PEERS / "splishsplash.py"), "--method", method)
            found.append(Program(f"SPlisHSPlasH {method}", splishsplash_python, words, "pysplishsplash"))
    return found
