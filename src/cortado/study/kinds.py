"""The kinds of experiments there are. A new one is a module beside this one, and an entry here."""

from cortado.study.experiment import Kind
from cortado.study.forces import FORCES
from cortado.study.gravity_and_precision import GRAVITY_AND_PRECISION
from cortado.study.image_horizon import IMAGE_HORIZON
from cortado.study.pressure_terms import PRESSURE_TERMS
from cortado.study.task import TASK

_ALL: tuple[Kind, ...] = (TASK, IMAGE_HORIZON, GRAVITY_AND_PRECISION, FORCES, PRESSURE_TERMS)
KINDS = {kind.name: kind for kind in _ALL}
