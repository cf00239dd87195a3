"""The registry of experiment types. A new one is a module beside this one, and an entry here."""

from experiments.experiment import ExperimentType
from experiments.forces import FORCES
from experiments.gravity_and_precision import GRAVITY_AND_PRECISION
from experiments.image_horizon import IMAGE_HORIZON
from experiments.locality import LOCALITY
from experiments.lyapunov import LYAPUNOV
from experiments.pressure_terms import PRESSURE_TERMS
from experiments.round_off import ROUND_OFF
from experiments.step_size import STEP_SIZE
from experiments.task import TASK
from experiments.wrong_adjoints import WRONG_ADJOINTS
from experiments.wrong_derivation import WRONG_DERIVATION

_ALL: tuple[ExperimentType, ...] = (
    *(TASK, IMAGE_HORIZON, GRAVITY_AND_PRECISION, FORCES, PRESSURE_TERMS),
    *(WRONG_ADJOINTS, WRONG_DERIVATION, STEP_SIZE, ROUND_OFF, LYAPUNOV, LOCALITY),
)
EXPERIMENT_TYPES = {one.name: one for one in _ALL}
