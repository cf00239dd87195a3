"""How the cameras of films move, as `cortado.pictures` has them."""

from cortado.scene.camera_paths import Dolly as Dolly
from cortado.scene.camera_paths import Follow as Follow
from cortado.scene.camera_paths import Keyframes as Keyframes
from cortado.scene.camera_paths import Orbit as Orbit
