"""What environments need of Gymnasium, or one sentence where it is not installed."""

from cortado.errors import LibraryMissingError

try:
    import gymnasium
    from gymnasium.utils.seeding import np_random
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    raise LibraryMissingError("Gymnasium", "gymnasium", "environments") from error

__all__ = ["AutoresetMode", "VectorEnv", "batch_space", "gymnasium", "np_random"]
