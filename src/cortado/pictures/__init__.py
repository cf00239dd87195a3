"""Pictures, films, plots and exports of runs, and target pictures. Differentiable pictures are in `cortado.render`."""

from cortado.lazy import getter

TYPE_CHECKING = False
if TYPE_CHECKING:
    from cortado.pictures.image_files import COFFEE as COFFEE
    from cortado.pictures.image_files import MILK as MILK
    from cortado.pictures.image_files import WHITE as WHITE
    from cortado.pictures.image_files import heart as heart
    from cortado.pictures.image_files import read_picture as read_picture
    from cortado.pictures.image_files import rosetta as rosetta
    from cortado.pictures.image_files import write_picture as write_picture
    from cortado.scene.appearance import Dolly as Dolly
    from cortado.scene.appearance import Follow as Follow
    from cortado.scene.appearance import Keyframes as Keyframes
    from cortado.scene.appearance import Orbit as Orbit

_PATHS = ("Dolly", "Follow", "Keyframes", "Orbit")
_FILES = ("COFFEE", "MILK", "WHITE", "heart", "read_picture", "rosetta", "write_picture")
__all__ = [*_PATHS, *_FILES]

if not TYPE_CHECKING:
    __getattr__ = getter(
        __name__, dict.fromkeys(_FILES, "image_files") | dict.fromkeys(_PATHS, "cortado.scene.appearance")
    )


def __dir__() -> list[str]:
    return __all__
