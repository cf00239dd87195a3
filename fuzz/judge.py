"""What is wrong with the end of a command, in sentences; none if all is well."""

import re
import signal
from collections.abc import Collection

from fuzz.processes import LIMITS, Limits, Outcome

CODES = (0, 1, 2)
"""Exit codes that the command line promises."""
LONGEST_SENTENCE = 1500
"""Characters of what a failed command says."""
_PROGRESS = re.compile(r"\w+ \d+/\d+, [\d:]+ left.*|(Compiling (\d+ kernel modules|kernels)|Packing the particles).*")
_AT_WORK = re.compile(r"Packing the particles[^:]*")
"""The last line of what takes long, says so, and answers an interruption at once."""
_CRASHES = ("Traceback (most recent call last)", "Fatal Python error", "Segmentation fault", "terminate called")


def complaints(
    outcome: Outcome, limits: Limits = LIMITS, codes: Collection[int] = CODES, heard: bool = True
) -> list[str]:
    """Sentences about an outcome, by what every command has to keep to; ``heard`` tells whether stderr was open."""
    if outcome.hung and _AT_WORK.fullmatch(outcome.err.rpartition("\n")[2]):
        return []
    if outcome.hung:
        return [f"hung for more than {limits.seconds:g} s{_place(outcome.stack)}"]
    found = []
    if outcome.swollen or outcome.memory > limits.memory:
        found.append(f"held {outcome.memory / 1e9:.1f} GB")
    if outcome.swollen:
        return found
    crash = next((word for word in _CRASHES if word in outcome.err or word in outcome.out), None)
    if crash is not None:
        found.append(f"printed {crash!r}: {_last_line(outcome.err or outcome.out)}")
    if outcome.code not in codes:
        how = f"died of {signal.Signals(-outcome.code).name}" if outcome.code < 0 else f"exit code {outcome.code}"
        found.append(f"{how}: {_last_line(outcome.err)}")
    if crash is None and heard:
        found += _about_words(outcome)
    return found


def _about_words(outcome: Outcome) -> list[str]:
    """Sentences about what was printed."""
    said = [line for line in outcome.err.splitlines() if not _PROGRESS.fullmatch(line)]
    sentences = [line for line in said if not line.startswith("Warning: ")]
    found = []
    if outcome.code == 0 and sentences:
        found.append(f"all is well, but stderr has: {_shortened(sentences[0])}")
    if outcome.code in (1, 2) and len(sentences) != 1:
        first = f", the first: {_shortened(sentences[0])}" if sentences else ""
        found.append(f"exit code {outcome.code} with {len(sentences)} lines on stderr instead of one{first}")
    if any(len(line) > LONGEST_SENTENCE for line in said):
        found.append(f"a line of {max(map(len, said))} characters on stderr: {_shortened(said[0])}")
    control = re.search(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]", outcome.out + outcome.err)
    if control is not None:
        found.append(f"the control character {control.group()!r} is printed")
    return found


def _last_line(text: str) -> str:
    lines = [line for line in text.splitlines() if line.strip()]
    return _shortened(lines[-1]) if lines else "without a word"


def _shortened(line: str) -> str:
    return line if len(line) <= 200 else f"{line[:200]}..."


def _place(stack: str) -> str:
    """Where a process was: the innermost line of the stack that it left."""
    places = re.findall(r'File "([^"]*)", line (\d+) in (\S+)', stack)
    own = [place for place in places if "cortado" in place[0]] or places
    return f" in {own[0][2]} ({own[0][0].rpartition('cortado/')[2]}:{own[0][1]})" if own else ""
