"""The films of the gallery: for each a picture, NAME.jpg, and an animated WebP, NAME.webp.

    python docs/site/gallery.py --device cuda:0 --out runs/gallery
    python docs/site/gallery.py --only honey --only jug

``--coarser 3 --part 0.1`` draws the first tenth of each film with spacings three times as wide, for a try on a CPU.
Several films run in separate processes, ``--at-a-time`` in parallel. Failed films do not stop other films. The script
deletes all runs.
"""

import argparse
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

FIGURES, TEMPLATES = (Path(__file__).parents[2] / folder for folder in ("docs/figures", "src/cortado/cli/templates"))
FRAMES, LASTS = 72, 3.6
"""Number of frames of a film, and duration of the film [s]."""
PICTURE = ("picture.width=640", "picture.height=360")
ORBIT = "picture.camera_path={kind = 'orbit', turns = 0.25}"
NEW = ("solver.time_step=auto",)
"""Setting for scenes whose time step is too long for the film's spacing."""

MIXED = "mixture={free_energy = 'miscible', mobility = 5e-7, mobility_form = 'constant'}"
"""Setting with which milk and coffee mix by Fick's law. Without the setting, single particles look like dots."""
DROP = "fluid.1.velocity=[0, -1.2, 0]", "phase.0.viscosity=0.05", "phase.1.viscosity=0.05", "picture.field_of_view=21"
"""Settings for a slow splash whose crown stays in one piece."""


@dataclass(frozen=True)
class Entry:
    """A film, and a picture from the film."""

    scene: Path
    spacing: float
    """Particle spacing [m], finer than in the scene."""
    seconds: float
    """Simulated time [s]."""
    still: float
    """Moment of the picture, from 0 at the start of the film to 1 at the end."""
    values: tuple[str, ...] = ()
    """Values that replace values of the scene, in the syntax of ``--set``."""

    def draw(self, name: str, folder: Path, run: Path, device: str, coarser: float, part: float) -> None:
        """Write the run into the folder ``run``, and the picture and the film into ``folder``."""
        from PIL import Image

        from cortado.cli.existing_runs import draw_runs
        from cortado.cli.run import RunRequest, run_scene
        from cortado.runs.recording import FramesPerSecond
        from cortado.runs.trajectory import Trajectory

        frames = FramesPerSecond((FRAMES - 1) / self.seconds)
        fine = f"discretisation.spacing={self.spacing * coarser:g}", f"picture.film_speed={self.seconds / LASTS:.3g}"
        values = [*PICTURE, *fine, *self.values]
        asked = {"time": self.seconds * part, "overrides": values, "device": device, "frames": frames}
        run_scene(self.scene, RunRequest(run, **asked, report=False))
        draw_runs([run], -1, True, folder / f"{name}.webp", [], device, {})
        last = len(Trajectory.load(run / "trajectory.vtkhdf")) - 1
        draw_runs([run], round(self.still * last), False, run / "still.png", [], device, {})
        Image.open(run / "still.png").save(folder / f"{name}.jpg", quality=90)


ENTRIES = {
    "shear": Entry(FIGURES / "shear.toml", 0.01, 3.0, 0.6),
    "pillar": Entry(TEMPLATES / "pillar.toml", 0.0125, 1.3, 0.35, NEW),
    "dam": Entry(FIGURES / "dam_break_large.toml", 0.014, 1.6, 0.5, NEW),
    "two_dams": Entry(FIGURES / "two_dams.toml", 0.016, 1.3, 0.5, NEW),
    "honey": Entry(FIGURES / "honey.toml", 0.0016, 1.2, 1.0, ("solver.time_step=0.0005", ORBIT)),
    "jug": Entry(FIGURES / "jug.toml", 0.00125, 1.8, 0.5),
    "turned_cup": Entry(FIGURES / "turned_cup.toml", 0.0018, 1.6, 0.4),
    "stirred": Entry(TEMPLATES / "stirred.toml", 0.0018, 1.2, 0.5, (*NEW, MIXED, "container.colour=[0.8, 0.78, 0.72]")),
    "rotor": Entry(FIGURES / "rotor.toml", 0.0026, 1.5, 0.7),
    "fountain": Entry(FIGURES / "fountain.toml", 0.004, 1.1, 0.8),
    "drop": Entry(TEMPLATES / "drop.toml", 0.0028, 0.2, 0.4, (*NEW, *DROP)),
    "raft": Entry(TEMPLATES / "raft.toml", 0.016, 1.8, 0.5, NEW),
    "baffles": Entry(FIGURES / "baffles.toml", 0.0065, 1.7, 0.4),
    "shaken": Entry(FIGURES / "shaken.toml", 0.0045, 0.75, 0.5, NEW),
    "ring": Entry(FIGURES / "ring.toml", 0.002, 2.3, 0.9),
    "beach": Entry(FIGURES / "beach.toml", 0.015, 3.0, 0.5),
    "two_layers": Entry(TEMPLATES / "rayleigh_taylor.toml", 0.004, 1.4, 0.7, NEW),
    "jet": Entry(TEMPLATES / "jet.toml", 0.005, 0.9, 0.8, (*NEW, "picture.colour=speed", "container.upper=[1.2, 0.7]")),
    "ink": Entry(FIGURES / "ink.toml", 0.0125, 1.8, 0.4),
    "surface_tension": Entry(FIGURES / "surface_tension.toml", 0.0006, 0.4, 0.1),
}


def main() -> int:
    """Draw the films of ``--only``, by default all films, and return the number of failures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", action="append", choices=ENTRIES, help="one of them; may be given again")
    parser.add_argument("--out", type=Path, default=Path("runs/gallery"))
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--at-a-time", type=int, default=1, help="processes side by side")
    parser.add_argument("--coarser", type=float, default=1.0, help="spacings are so many times as wide")
    parser.add_argument("--part", type=float, default=1.0, help="of the time of each film, from its start")
    asked = parser.parse_args()
    names = asked.only or list(ENTRIES)
    asked.out.mkdir(parents=True, exist_ok=True)
    if len(names) == 1:
        with TemporaryDirectory() as run:
            ENTRIES[names[0]].draw(names[0], asked.out, Path(run) / "run", asked.device, asked.coarser, asked.part)
        return 0
    cores = max(1, (os.cpu_count() or 1) // asked.at_a_time)
    threads = dict.fromkeys(("CORTADO_CORES", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(cores))
    shared = ["--device", asked.device, "--out", asked.out, "--coarser", asked.coarser, "--part", asked.part]

    def make(name: str) -> int:
        begun, log = time.monotonic(), asked.out / f"{name}.log"
        command = [sys.executable, __file__, "--only", name, *map(str, shared)]
        with log.open("w") as words:
            code = subprocess.run(command, stdout=words, stderr=words, env={**os.environ, **threads}).returncode
        told = "done" if code == 0 else f"FAILED, see {log}"
        print(f"{name:<16} {time.monotonic() - begun:6.1f} s  {told}", flush=True)
        return int(code != 0)

    with ThreadPoolExecutor(asked.at_a_time) as processes:
        return sum(processes.map(make, names))


if __name__ == "__main__":
    sys.exit(main())
