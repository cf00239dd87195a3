"""The registry of experiment types. A new one is a module beside this one, and an entry here."""

from cortado.study.experiment import ExperimentType
from cortado.study.forces import FORCES
from cortado.study.gravity_and_precision import GRAVITY_AND_PRECISION
from cortado.study.image_horizon import IMAGE_HORIZON
from cortado.study.locality import LOCALITY
from cortado.study.lyapunov import LYAPUNOV
from cortado.study.pressure_terms import PRESSURE_TERMS
from cortado.study.round_off import ROUND_OFF
from cortado.study.step_size import STEP_SIZE
from cortado.study.task import TASK
from cortado.study.wrong_adjoints import WRONG_ADJOINTS
from cortado.study.wrong_derivation import WRONG_DERIVATION

_ALL: tuple[ExperimentType, ...] = (
    *(TASK, IMAGE_HORIZON, GRAVITY_AND_PRECISION, FORCES, PRESSURE_TERMS),
    *(WRONG_ADJOINTS, WRONG_DERIVATION, STEP_SIZE, ROUND_OFF, LYAPUNOV, LOCALITY),
)
EXPERIMENT_TYPES = {one.name: one for one in _ALL}
