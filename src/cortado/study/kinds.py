"""The kinds of experiments there are. A new one is a module beside this one, and an entry here."""

from cortado.study.experiment import Kind

_ALL: tuple[Kind, ...] = ()
KINDS = {kind.name: kind for kind in _ALL}
