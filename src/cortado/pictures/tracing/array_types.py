"""Types of arrays that kernels and Warp functions take."""

import warp as wp

Ints, Ints2d = wp.array(dtype=wp.int32), wp.array2d(dtype=wp.int32)
Floats, Floats2d = wp.array(dtype=wp.float32), wp.array2d(dtype=wp.float32)
Vec2s, Vec3s = wp.array(dtype=wp.vec2), wp.array(dtype=wp.vec3)
Vec3s2d, Vec4s2d = wp.array2d(dtype=wp.vec3), wp.array2d(dtype=wp.vec4)
