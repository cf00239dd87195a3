"""Surfaces as triangles with the light on them, as Warp functions: that of the fluid, and those of solids."""

import warp as wp


@wp.struct
class LitSurface:
    """Triangles with what is known at their corners."""

    mesh: wp.uint64
    corners: wp.array(dtype=wp.int32)
    """(3 triangles,) indices of points"""
    normals: wp.array(dtype=wp.vec3)
    """(points,) outwards"""
    colours: wp.array(dtype=wp.vec3)
    """(points,)"""
    light: wp.array(dtype=wp.vec3)
    """(points,) light that falls on the surface, of which white reflects 1"""
    media: wp.array(dtype=wp.vec2)
    """(points,) of a fluid: scattering and absorption [1/m]"""
    is_flat: wp.int32
    """Whether its colours are shown as they are, without light and shadow."""
    reach: wp.float32
    """How far behind a wall the triangles of fluid that touches it are, at most [m]."""
    left: wp.array(dtype=wp.vec2)
    """(triangles,) of transparent solids: the part of the light that comes through, seen from within and outside"""
    reflectivity: wp.array(dtype=wp.float32)
    """(triangles,) of opaque solids: the part of the light that they reflect as a mirror in their colour does"""
    from_edges: wp.array(dtype=wp.mat33)
    """(triangles,) of transparent solids: how far corners, the columns, are from up to three sharp edges [m]"""


@wp.func
def at_corners(surface: LitSurface, values: wp.array(dtype=wp.vec3), face: wp.int32, u: wp.float32, v: wp.float32):
    """Interpolated on a triangle."""
    return (
        u * values[surface.corners[3 * face]]
        + v * values[surface.corners[3 * face + 1]]
        + (1.0 - u - v) * values[surface.corners[3 * face + 2]]
    )


@wp.func
def facing(normal: wp.vec3, face_normal: wp.vec3, d: wp.vec3):
    """An interpolated normal on the side of the triangle that the ray comes from."""
    outside = face_normal
    n = normal
    if wp.dot(outside, d) > 0.0:
        outside = -outside
        n = -n
    cosine = wp.dot(n, d)
    if cosine > -0.02:
        n = n - (cosine + 0.02) * d
    return wp.normalize(n)


@wp.struct
class SurfaceHit:
    """Where a ray hits a surface."""

    found: wp.bool
    is_solid: wp.bool
    """Whether it is that of an opaque solid."""
    t: wp.float32
    normal: wp.vec3
    """On the side that the ray comes from."""
    colour: wp.vec3
    light: wp.vec3
    reflectivity: wp.float32
    """Of a solid."""
    face: wp.int32
    u: wp.float32
    v: wp.float32


@wp.func
def at_surface(surface: LitSurface, t: wp.float32, d: wp.vec3, face: wp.int32, u: wp.float32, v: wp.float32):
    """Where a ray hits a triangle."""
    i = surface.corners[3 * face]
    j = surface.corners[3 * face + 1]
    k = surface.corners[3 * face + 2]
    mesh = wp.mesh_get(surface.mesh)
    flat = wp.normalize(wp.cross(mesh.points[j] - mesh.points[i], mesh.points[k] - mesh.points[i]))
    met = SurfaceHit()
    met.found = True
    met.t = t
    met.normal = facing(at_corners(surface, surface.normals, face, u, v), flat, d)
    met.colour = at_corners(surface, surface.colours, face, u, v)
    met.light = at_corners(surface, surface.light, face, u, v)
    met.face = face
    met.u = u
    met.v = v
    return met


@wp.func
def medium_at(surface: LitSurface, met: SurfaceHit):
    """Scattering and absorption [1/m] of the fluid that a ray comes into."""
    return (
        met.u * surface.media[surface.corners[3 * met.face]]
        + met.v * surface.media[surface.corners[3 * met.face + 1]]
        + (1.0 - met.u - met.v) * surface.media[surface.corners[3 * met.face + 2]]
    )
