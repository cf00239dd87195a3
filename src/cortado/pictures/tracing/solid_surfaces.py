"""Surfaces of solids on the device of the ray tracer, and the soft shadow of fluid and solids on the floor."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from cortado.device.launching import BandLauncher
from cortado.device.launching import launch as launch_once
from cortado.device.modules import kernel_module
from cortado.device.precision import TypesByName
from cortado.discretise.shapes import Points
from cortado.pictures.shown_solids import ShownSolid, SolidMesh
from cortado.pictures.stage import Stage
from cortado.pictures.tracing.backdrop import LitSurface, Solids
from cortado.pictures.tracing.liquid_surface import Mesh
from cortado.pictures.tracing.near_particles import Floats, Looks, Particles, Vec3s, Vec3s2d, Vec4s2d

NODES = 320
"""Number of floor nodes along each axis at which the shadow is computed."""
ABOVE = 1e-3
"""Greatest height of faces of solids without a shadow, as a fraction of `Stage.size`."""
REACH = 1.5
"""Half the width of the floor area with shadows, as a multiple of `Stage.size`."""
KEY, AROUND = 0.022, 0.05
"""Widths of the blur of the lamp's shadow and of the sky's shadow, as fractions of `Stage.size`."""
CLOSE = 0.15
"""Greatest height of objects that shade the floor from the sky, as a fraction of `Stage.size`."""
SKY = 0.32
Soften = Callable[[wp.array], wp.array]


@dataclass(frozen=True)
class DeviceSurface:
    mesh: wp.Mesh
    lit: Any
    softened: Soften | None = None

    @classmethod
    def of(
        cls, points: wp.array, triangles: wp.array, normals: wp.array, colours: wp.array, softened: Soften | None = None
    ) -> "DeviceSurface":
        """``points`` (p,) are in metres, and ``triangles`` (3 t,) are vertex indices."""
        mesh, found = wp.Mesh(points, triangles), LitSurface()
        found.mesh, found.corners, found.normals, found.colours = mesh.id, triangles, normals, colours
        found.light, found.media = wp.zeros_like(points), wp.zeros(len(points), dtype=wp.vec2, device=points.device)
        return cls(mesh, found, softened)

    @classmethod
    def on(cls, device: Any, mesh: Mesh, softened: Soften | None = None) -> "DeviceSurface":
        corners = wp.array(mesh.triangles.ravel(), dtype=wp.int32, device=device)
        own = [wp.array(one, dtype=wp.vec3, device=device) for one in (mesh.points, mesh.normals, mesh.colours)]
        return cls.of(own[0], corners, own[1], own[2], softened)


FINE, FINE_OWN = 0.03, 0.05
"""Greatest width of the faces of round solids, as fractions of `Stage.size` and of the solid's size."""
LONGEST = 0.04
"""Greatest side of a triangle at whose corners light is computed, as a fraction of `Stage.size`."""
MODULE = kernel_module("shadow")
typed = TypesByName(
    wp.float32,
    {
        wp.int32: "first across",
        Vec3s: "places",
        Looks: "looks",
        Floats: "volumes weights",
        wp.vec3: "corner",
        wp.vec2: "slope strength",
        wp.vec2i: "begin",
        Vec4s2d: "thickness sharp found key around",
        Vec3s2d: "light",
    },
)


@wp.kernel(module=MODULE, enable_backward=False)
@typed
def cast(places, looks, volumes, corner, cell, slope, fading, begin, thickness):
    """``fading`` [1/m] is the rate at which a shadow fades with height."""
    i = wp.tid()
    height = places[i][1] - corner[1]
    x = (places[i][0] - height * slope[0] - corner[0]) / cell
    z = (places[i][2] - height * slope[1] - corner[2]) / cell
    u = int(wp.floor(x)) - begin[0]
    v = int(wp.floor(z)) - begin[1]
    if u >= 0 and v >= 0 and u + 1 < thickness.shape[0] and v + 1 < thickness.shape[1]:
        c = looks[i]
        above = volumes[i] * wp.exp(-fading * height) / (cell * cell) * wp.vec4(c[0], c[1], c[2], 1.0)
        for n in range(4):
            m = n & 1
            k = n >> 1
            a = 1.0 - wp.abs(x - float(begin[0] + u + m))
            b = 1.0 - wp.abs(z - float(begin[1] + v + k))
            wp.atomic_add(thickness, u + m, v + k, a * b * above)


@wp.kernel(module=MODULE, enable_backward=False)
@typed
def blur(first, across, weights, sharp, found):
    n = first + wp.tid()
    i = n / sharp.shape[1]
    j = n % sharp.shape[1]
    total = wp.vec4(0.0)
    for k in range(1 - weights.shape[0], weights.shape[0]):
        u = i + wp.where(across > 0, 0, k)
        v = j + wp.where(across > 0, k, 0)
        if u >= 0 and v >= 0 and u < sharp.shape[0] and v < sharp.shape[1]:
            total += weights[wp.abs(k)] * sharp[u, v]
    found[i, j] = total


@wp.func
def kept_off(above: wp.vec4, layer: wp.float32, opacity: wp.float32, tinted: wp.float32):
    reached = 1.0 - wp.exp(-above[3] / (0.75 * layer))
    colour = wp.vec3(above[0], above[1], above[2])
    hue = colour / wp.max(wp.max(colour), 1.0e-6 * wp.max(above[3], 1.0e-12))
    return reached * (wp.vec3(opacity - 0.35 * tinted) - 0.65 * tinted * hue)


@wp.kernel(module=MODULE, enable_backward=False)
@typed
def darken(first, key, around, strength, layer, opacity, tinted, begin, light):
    """Darken ``light`` in place by two shadows of an object: from the lamp and from the sky."""
    n = first + wp.tid()
    i = n / key.shape[1]
    j = n % key.shape[1]
    left = wp.vec3(1.0) - strength[0] * kept_off(key[i, j], layer, opacity, tinted)
    left -= strength[1] * kept_off(around[i, j], layer, opacity, tinted)
    u = begin[0] + i
    v = begin[1] + j
    light[u, v] = wp.min(light[u, v], left)


class FloorShadow:
    def __init__(self, stage: Stage, launch: BandLauncher):
        middle = 0.5 * (stage.lower + stage.upper)
        self._stage, self._launch, self._device = stage, launch, launch.device
        self.corner = np.array([middle[0], stage.lower[1], middle[2]]) - np.array([REACH, 0.0, REACH]) * stage.size
        """Position of the first node (3,) [m]."""
        self.cell = 2.0 * REACH * stage.size / (NODES - 1)
        """Distance between nodes [m]."""
        self.light = wp.ones((NODES, NODES), dtype=wp.vec3, device=self._device)
        """Fraction of light at each node (nodes, nodes), along x and z."""

    def of_fluid(self, particles: Particles) -> None:
        stage = self._stage
        volumes = wp.full(len(particles), stage.spacing**3, dtype=wp.float32, device=self._device)
        self._add(particles, [volumes, volumes], 0.8 * stage.spacing, 1.0, 0.4 * stage.transparency)

    def of_solid(self, shown: ShownSolid, mesh: SolidMesh) -> None:
        stage = self._stage
        a, b, c = mesh.points[mesh.triangles].transpose(1, 0, 2)
        middle = (a + b + c) / 3.0
        casts = middle[:, 1] > stage.lower[1] + ABOVE * stage.size
        if stage.cuts_solids:
            casts &= ((middle >= stage.lower) & (middle <= stage.upper))[:, ::2].all(axis=1)
        middle, area = middle[casts], 0.5 * np.cross(b - a, c - a)[casts]
        volumes = 3.0 * stage.spacing * np.abs(np.stack([area @ stage.sun / stage.sun[1], area[:, 1]]))
        parts = Particles.on(self._device, middle, np.tile(shown.colour, (len(middle), 1)))
        self._add(parts, [self._array(one) for one in volumes], 0.0, 1.0 - shown.finish.transparency, 0.0)

    def _add(self, parts: Particles, volumes: list[wp.array], least: float, opacity: float, tinted: float) -> None:
        """``volumes`` (n,) [m3] are for the lamp and for the sky. ``least`` [m] is the smallest width of the blur."""
        if not len(parts):
            return
        stage = self._stage
        slope = stage.sun[::2] / stage.sun[1]
        bells = list[Points]()
        for part in (KEY, AROUND):
            soft = max(part * stage.size, least) / self.cell  # standard deviation of a bell [nodes]
            bell = np.exp(-0.5 * (np.arange(int(4.0 * soft + 0.5) + 1) / soft) ** 2)
            bells.append(bell / (2.0 * bell.sum() - 1.0))
        begin, shape = self._reached(parts, slope, max(map(len, bells)))
        seen = {"begin": wp.vec2i(*begin), "corner": wp.vec3(*self.corner), "cell": self.cell}
        key = self._thickness(parts, volumes[0], bells[0], shape, slope=wp.vec2(*slope), fading=0.0, **seen)
        own = {"slope": wp.vec2(0.0, 0.0), "fading": 1.0 / (CLOSE * stage.size)}
        around = self._thickness(parts, volumes[1], bells[1], shape, **own, **seen)
        strength = wp.vec2(stage.picture.sun_and_sky.shadow, SKY)
        how = {"strength": strength, "layer": stage.spacing, "opacity": opacity, "tinted": tinted}
        self._launch(darken, key.size, key=key, around=around, **how, begin=seen["begin"], light=self.light)

    def _reached(self, parts: Particles, slope: Points, around: int) -> tuple[list[int], tuple[int, int]]:
        """Return the first node of the shadow of ``parts`` on the floor, and the number of nodes along each axis."""
        lower, upper = (end - self.corner for end in parts.ends(self._launch))
        shifts = np.outer((0.0, lower[1], upper[1]), slope)
        first = np.floor((lower[::2] - shifts.max(axis=0)) / self.cell) - around
        last = np.ceil((upper[::2] - shifts.min(axis=0)) / self.cell) + around
        first, last = (np.clip(end, 0, NODES - 2).astype(int) for end in (first, last))
        rows, columns = (last - first + 2).tolist()
        return first.tolist(), (rows, columns)

    def _thickness(self, parts: Particles, volumes: wp.array, bell: Points, shape: tuple[int, int], **at: Any) -> Any:
        sharp = wp.zeros(shape, dtype=wp.vec4, device=self._device)
        given = {"places": parts.places, "looks": parts.looks, "volumes": volumes}
        launch_once(cast, len(volumes), self._device, **given, **at, thickness=sharp)
        weights, other = self._array(bell), wp.empty_like(sharp)
        self._launch(blur, sharp.size, across=0, weights=weights, sharp=sharp, found=other)
        self._launch(blur, sharp.size, across=1, weights=weights, sharp=other, found=sharp)
        return sharp

    def _array(self, values: Points) -> wp.array:
        return wp.array(values.astype(np.float32), dtype=wp.float32, device=self._device)


class SolidSurfaces:
    def __init__(self, stage: Stage, device: Any):
        self._stage, self._device, self._own = stage, device, dict[str, SolidMesh]()
        for one in stage.solids:  # relative to its middle; that of a tank is of its cavity
            own = float(np.ptp(one.shape.extent(), axis=0).max())
            faces = one.shape.shown_faces(min(FINE * stage.size, FINE_OWN * own))
            is_clear = one.finish.transparency == 1.0  # and has no own light
            longest = np.inf if is_clear else LONGEST * stage.size
            self._own[one.name] = SolidMesh.of(faces.reversed() if one.is_tank else faces, longest)

    @property
    def kinds(self) -> tuple[bool, bool]:
        """Two flags: True if there are opaque solids, and True if there are transparent solids."""
        clear = [_is_clear(one) for one in self._stage.solids]
        return not all(clear), any(clear)

    def cast(self, shadow: FloorShadow, solids: Sequence[ShownSolid]) -> None:
        for one, mesh in self._placed(solids):
            if not one.is_tank:
                shadow.of_solid(one, mesh)

    def on_device(self, solids: Sequence[ShownSolid]) -> tuple[Any, list[DeviceSurface]]:
        """Return a struct `Solids` and its surfaces. The caller must keep the surfaces alive."""
        found, surfaces, lit = Solids(), list[DeviceSurface](), [LitSurface(), LitSurface()]
        found.are_cut, placed = int(self._stage.cuts_solids), self._placed(solids)
        for k, is_clear in enumerate((False, True)):
            if not (own := [pair for pair in placed if _is_clear(pair[0]) == is_clear]):
                continue
            mesh, counts = SolidMesh.joined([one for _, one in own]), [len(one.triangles) for _, one in own]
            colours = np.concatenate([np.tile(one.colour, (len(points.points), 1)) for one, points in own])
            whole = Mesh(mesh.points, mesh.triangles, mesh.normals, colours)
            surfaces.append(DeviceSurface.on(self._device, whole, partial(self._softened, mesh)))
            lit[k] = surfaces[-1].lit
            if is_clear:
                found.clear, found.has_tank = lit[k].mesh, int(any(one.is_tank for one, _ in own))
                kept = [(one.finish.transparency, one.is_tank) for one, _ in own]
                left = [(1.0, part) if is_tank else (part**0.5, part**0.5) for part, is_tank in kept]
                passed = np.repeat(left, counts, axis=0)  # of light, at a surface from inside and from outside
                lit[k].left = wp.array(passed, dtype=wp.vec2, device=self._device)
                lit[k].from_edges = wp.array(mesh.from_edges, dtype=wp.mat33, device=self._device)
            else:
                found.opaque = lit[k].mesh
                mirrors = np.repeat([one.finish.reflectivity for one, _ in own], counts)
                lit[k].reflectivity = wp.array(mirrors, dtype=wp.float32, device=self._device)
        found.surfaces = wp.array(lit, dtype=LitSurface, device=self._device)
        return found, surfaces

    def _placed(self, solids: Sequence[ShownSolid]) -> list[tuple[ShownSolid, SolidMesh]]:
        return [(one, self._own[one.name].moved(one.turn, one.position)) for one in solids]

    def _softened(self, mesh: SolidMesh, light: wp.array) -> wp.array:
        return wp.array(mesh.smoothed(light.numpy()), dtype=wp.vec3, device=self._device)


def _is_clear(shown: ShownSolid) -> bool:
    return shown.is_tank or shown.finish.transparency > 0.0
