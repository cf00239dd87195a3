"""Sun and sky of shaded pictures, by their names."""

from dataclasses import dataclass

Numbers = tuple[float, ...]


@dataclass(frozen=True)
class Light:
    """A lamp, the sun, before a sky, and a weak strip of light on the other side; colours are linear."""

    azimuth: float
    """Of the sun, to the right of the camera where it begins, which looks from there [degrees]."""
    elevation: float
    """Of the sun, above the floor [degrees]."""
    lamp: Numbers
    """What is seen of the sun in reflections."""
    strip: Numbers
    """What is seen of the strip."""
    sunlight: Numbers
    """The light of the sun that falls on what faces it, of which white reflects 1."""
    shadow: float
    """The part of the light on the floor that is the sun's."""
    background: Numbers
    """The horizon, if a picture does not say which."""
    zenith: Numbers
    """The colour above, in parts of the horizon's."""


LIGHTS = {
    "studio": Light(
        azimuth=-62.0,
        elevation=50.0,
        lamp=(7.0, 6.8, 6.4),
        strip=(1.6, 1.7, 1.8),
        sunlight=(0.62, 0.60, 0.57),
        shadow=0.48,
        background=(0.74, 0.77, 0.80),
        zenith=(0.62, 0.72, 0.84),
    ),
    "noon": Light(
        azimuth=-50.0,
        elevation=68.0,
        lamp=(9.0, 8.7, 8.0),
        strip=(0.0, 0.0, 0.0),
        sunlight=(0.78, 0.75, 0.68),
        shadow=0.58,
        background=(0.62, 0.73, 0.86),
        zenith=(0.36, 0.56, 0.86),
    ),
    "evening": Light(
        azimuth=-78.0,
        elevation=20.0,
        lamp=(9.0, 5.2, 2.4),
        strip=(0.5, 0.6, 0.9),
        sunlight=(0.90, 0.55, 0.28),
        shadow=0.50,
        background=(0.76, 0.58, 0.46),
        zenith=(0.42, 0.60, 1.05),
    ),
    "overcast": Light(
        azimuth=-62.0,
        elevation=60.0,
        lamp=(0.0, 0.0, 0.0),
        strip=(0.4, 0.4, 0.4),
        sunlight=(0.12, 0.12, 0.12),
        shadow=0.12,
        background=(0.62, 0.65, 0.68),
        zenith=(1.15, 1.15, 1.15),
    ),
}
"""By their names."""
