"""The cases that are done, one a line in a file, so that a campaign goes on where it was stopped."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path


@dataclass(frozen=True)
class Entry:
    """What came of one case."""

    case: str
    """Such as "scenes:17"."""
    complaints: list[str]
    """None if all was well."""
    notes: list[str]
    """What was done."""
    codes: list[int]
    """Exit codes of its commands."""
    seconds: float
    """From its start to its end."""
    computed: float
    """[s] of computing."""
    memory: int
    """The most bytes that a command of it held."""


class Ledger:
    """Entries in the order in which they came; the last one of a case counts."""

    def __init__(self, path: Path):
        self._path = path
        self.entries: dict[str, Entry] = {}
        if path.exists():
            for line in path.read_text(encoding="utf-8").splitlines():
                self._take(line)

    def add(self, entry: Entry) -> None:
        """Keep an entry, also if the campaign is killed next."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        torn = self._path.exists() and not self._path.read_bytes().endswith(b"\n")
        with open(self._path, "a", encoding="utf-8") as file:
            file.write("\n" * torn + json.dumps(asdict(entry)) + "\n")
        self.entries[entry.case] = entry

    def clear(self) -> None:
        """Forget everything."""
        self._path.unlink(missing_ok=True)
        self.entries.clear()

    def failed(self) -> list[Entry]:
        """Those with complaints."""
        return [entry for entry in self.entries.values() if entry.complaints]

    def _take(self, line: str) -> None:
        try:
            entry = Entry(**json.loads(line))
        except (ValueError, TypeError):  # a line that a kill has torn
            return
        self.entries[entry.case] = entry
