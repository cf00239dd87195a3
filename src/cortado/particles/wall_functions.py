"""What sums over walls load of a wall particle."""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import Precision
from cortado.particles.loads import loads


@cache
def wall_functions(precision: Precision, taped: bool, neighbourhood: Any) -> dict[str, Any]:
    """Warp functions of its number b and the neighbourhood, by name."""
    real, vector = precision.real, precision.vector
    load = loads(precision, taped)
    load_vector, load_number = load.vector, load.number

    @wp.func
    def wall_position(b: int, s: neighbourhood) -> vector:
        return load_vector(s.wall_positions, b)

    @wp.func
    def wall_weight(b: int, s: neighbourhood) -> real:
        return load_number(s.wall_weights, b)

    @wp.func
    def wall_grip(b: int, s: neighbourhood) -> real:
        return load_number(s.wall_grips, b)

    @wp.func
    def wall_foot(b: int, s: neighbourhood) -> vector:
        return load_vector(s.wall_feet, b)

    @wp.func
    def wall_velocity(b: int, s: neighbourhood) -> vector:
        return load_vector(s.wall_velocities, b)

    @wp.func
    def wall_solid(b: int, s: neighbourhood) -> int:
        return s.wall_solids[b]

    @wp.func
    def weight_in(b: int, solid: int, s: neighbourhood) -> real:
        weight = real(0.0)
        if s.wall_solids[b] == solid:
            weight = load_number(s.wall_weights, b)
        return weight

    @wp.func
    def wall_position_dot(b: int, s: neighbourhood) -> vector:
        return load_vector(s.wall_positions_dot, b)

    @wp.func
    def wall_velocity_dot(b: int, s: neighbourhood) -> vector:
        return load_vector(s.wall_velocities_dot, b)

    @wp.func
    def wall_turn_dot(b: int, s: neighbourhood) -> vector:
        return load_vector(s.wall_turns_dot, b)

    @wp.func
    def wall_growth_dot(b: int, s: neighbourhood) -> real:
        return load_number(s.wall_growths_dot, b)

    return {
        "wall_position": wall_position,
        "wall_weight": wall_weight,
        "wall_grip": wall_grip,
        "wall_foot": wall_foot,
        "wall_velocity": wall_velocity,
        "wall_solid": wall_solid,
        "weight_in": weight_in,
        "wall_position_dot": wall_position_dot,
        "wall_velocity_dot": wall_velocity_dot,
        "wall_turn_dot": wall_turn_dot,
        "wall_growth_dot": wall_growth_dot,
    }
