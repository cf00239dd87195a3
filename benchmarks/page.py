"""Write what benchmarks print into the pages of `docs/`: ``python benchmarks/page.py``, or with ``--device cuda:0``.

A place that is measured stands between two comments, of which the first has its command:

    <!-- measured by: python -m benchmarks watching --depth 12 --steps 64 -->
    <!-- end of measured -->

The command, the date, the commit, the machine, how busy others kept it, and what the command prints are written between
them.
"""

import argparse
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from textwrap import fill

from programs import seconds_of_children

from benchmarks.bench.environment import OtherProcesses, environment
from benchmarks.bench.learning import device_name

ROOT = Path(__file__).parents[1]
PLACE = re.compile(r"(<!-- measured by: (python .*?) -->\n).*?(<!-- end of measured -->)", re.DOTALL)


def device_of(command: str) -> str:
    """The device that a command measures."""
    words = shlex.split(command)
    return words[words.index("--device") + 1] if "--device" in words else "cpu"


def measured(command: str, commit: str | None) -> str:
    """What stands in the place of a command: itself, where and when it ran beside what, and what it printed; ends the
    process where it fails."""
    import warp as wp

    wp.config.quiet = True
    paths = os.pathsep.join([str(ROOT / "src"), str(ROOT), os.environ.get("PYTHONPATH", "")])
    words, others = [sys.executable, *shlex.split(command)[1:]], OtherProcesses(seconds_of_children)
    done = subprocess.run(words, capture_output=True, text=True, cwd=ROOT, env={**os.environ, "PYTHONPATH": paths})
    if done.returncode:
        sys.exit(f"{command} failed: {done.stderr.strip()[-500:]}")
    around, busy = environment(), others.busy_cores()
    machine = device_name(device_of(command), around["processor"])
    said = (
        f"`{command}`, {around['date'][:10]}, commit {commit or around['commit'] or 'not known'}, {machine}, "
        f"{'one core, by its time' if around['cores'] == 1 else str(around['cores']) + ' cores'}; other processes kept "
        f"{'an unknown number' if busy is None else busy} busy:"
    )
    printed = done.stdout.strip()
    shown = printed if printed.startswith("|") else f"```text\n{printed}\n```"
    return f"{fill(said, 120, break_on_hyphens=False)}\n\n{shown}\n"


def main() -> None:
    parser = argparse.ArgumentParser(description="Write what benchmarks print into the pages of docs/.")
    parser.add_argument("--device", default="cpu", help='measure the places of "cpu", or those of "cuda:0"')
    parser.add_argument("--only", default="", metavar="WORD", help="those alone whose commands have this word")
    parser.add_argument("--commit", help="the commit, where there is no clone to ask")
    given = parser.parse_args()

    def written(place: re.Match[str]) -> str:
        begin, command, end = place.groups()
        if device_of(command) != given.device or given.only not in command:
            return place.group()
        print(command, flush=True)
        return f"{begin}{measured(command, given.commit)}{end}"

    for page in sorted((ROOT / "docs").glob("*.md")):
        for place in PLACE.finditer(page.read_text(encoding="utf-8")):
            new = written(place)
            page.write_text(page.read_text(encoding="utf-8").replace(place.group(), new), encoding="utf-8")


if __name__ == "__main__":
    main()
