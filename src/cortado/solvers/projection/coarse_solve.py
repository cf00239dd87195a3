"""Solves the equations of the coarse pressure in one kernel launch.

The solver uses conjugate gradients (Hestenes and Stiefel 1952) with a multigrid cycle as preconditioner
(`cortado.solvers.projection.coarse_levels`). The multigrid cycle ignores rigid bodies.

CPUs and GPUs run the same C++ source. On a CPU, one thread solves the equations of a scene. On a GPU, a team of thread
blocks solves the equations of a scene, and the blocks wait for each other at barriers. Results do not depend on the
number of blocks, because sums are made of partial sums over `BLOCK` nodes.
"""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.modules import kernel_module
from cortado.device.precision import Precision

BLOCK = 512
ALONE = 4 * BLOCK
"""A single GPU block works on a level with at most this number of nodes."""

ON_A_CPU = """
    const int first = thread, teams = system.members;
    const bool lead = true;
    auto each = [&](bool, int n, auto work) { for (int i = 0; i < n; ++i) work(i); };
    auto meet = [&]() {};
    auto sum = [&](int n, auto share) -> T {
        double total = 0.0;
        for (int i = 0; i < n; ++i) total += share(i);
        return T(total);
    };
"""
ON_A_GPU = """
    __shared__ T room[BLOCK];
    const int first = blockIdx.x / system.team, teams = gridDim.x / system.team, rank = blockIdx.x % system.team;
    const int t = threadIdx.x;
    const bool lead = rank == 0 && t == 0;
    volatile int* waiting = system.gate.data + 2 * first;
    auto meet = [&]() {
        __syncthreads();
        if (system.team > 1) {
            if (t == 0) {
                __threadfence();
                const int turn = waiting[1];
                if (atomicAdd((int*)waiting, 1) == system.team - 1) {
                    waiting[0] = 0;
                    __threadfence();
                    waiting[1] = turn + 1;
                } else {
                    while (waiting[1] == turn);
                }
                __threadfence();
            }
            __syncthreads();
        }
    };
    auto each = [&](bool alone, int n, auto work) {
        if (!alone) for (int i = rank * BLOCK + t; i < n; i += system.team * BLOCK) work(i);
        else if (rank == 0) for (int i = t; i < n; i += BLOCK) work(i);
        if (alone) __syncthreads(); else meet();
    };
    auto tree = [&](T value) -> T {
        __syncthreads();
        room[t] = value;
        for (int half = BLOCK / 2; half > 0; half /= 2) {
            __syncthreads();
            if (t < half) room[t] += room[t + half];
        }
        __syncthreads();
        return room[0];
    };
    auto sum = [&](int n, auto share) -> T {
        const int parts = (n + BLOCK - 1) / BLOCK;
        T* own = system.partial.data + (long long)first * parts;
        for (int part = rank; part < parts; part += system.team) {
            const int i = part * BLOCK + t;
            const T total = tree(i < n ? share(i) : T(0));
            if (t == 0) own[part] = total;
        }
        meet();
        T total = T(0);
        for (int part = t; part < parts; part += BLOCK) total += own[part];
        return tree(total);
    };
"""

SOLVE = """
    struct Level { int n[3], factor[3], nodes; long long at, entries; };
    const int levels = system.starts.shape[0];
    auto level = [&](int l) -> Level {
        const int* row = system.shapes.data + 6 * l;
        const int a = row[0], b = row[1], c = row[2];
        return {{a, b, c}, {row[3], row[4], row[5]}, a * b * c, system.starts.data[l], AROUND * system.starts.data[l]};
    };
    auto alone = [&](int l) { return l > 0 && level(l).nodes <= ALONE; };
    auto wrapped = [](int i, int n) { return i < 0 ? i + n : (i < n ? i : i - n); };

    for (int member = first; member < system.members; member += teams) {
        auto of = [&](wp::array_t<T>& values, const Level& own) -> T* {
            return values.data + own.at + (long long)member * own.nodes;
        };
        auto product = [&](const Level& own, int i, auto value) -> T {
            const int* n = own.n;
            const int x = i % n[0], y = (i / n[0]) % n[1], z = i / (n[0] * n[1]);
            const long long all = (long long)system.members * own.nodes;
            const T* entry = system.A.data + own.entries + (long long)member * own.nodes + i;
            T total = T(0);
            for (int c = FLAT ? 0 : -1; c <= (FLAT ? 0 : 1); ++c) {
                const int layer = wrapped(z + c, n[2]) * n[1];
                for (int b = -1; b <= 1; ++b) {
                    const int line = (layer + wrapped(y + b, n[1])) * n[0];
                    for (int a = -1; a <= 1; ++a, entry += all) total += *entry * value(line + wrapped(x + a, n[0]));
                }
            }
            return total;
        };
        auto restricted = [&](const Level& fine, const Level& own, int i, const T* left) -> T {
            const int at[3] = {i % own.n[0], (i / own.n[0]) % own.n[1], i / (own.n[0] * own.n[1])};
            const int *f = own.factor, *n = fine.n;
            T total = T(0);
            for (int c = 1 - f[2]; c < f[2]; ++c)
            for (int b = 1 - f[1]; b < f[1]; ++b)
            for (int a = 1 - f[0]; a < f[0]; ++a) {
                const int x = wrapped(at[0] * f[0] + a, n[0]), y = wrapped(at[1] * f[1] + b, n[1]);
                const T part = (a ? T(0.5) : T(1)) * (b ? T(0.5) : T(1)) * (c ? T(0.5) : T(1));
                total += part * left[(wrapped(at[2] * f[2] + c, n[2]) * n[1] + y) * n[0] + x];
            }
            return total;
        };
        auto prolonged = [&](const Level& fine, const Level& own, int i, const T* z) -> T {
            const int at[3] = {i % fine.n[0], (i / fine.n[0]) % fine.n[1], i / (fine.n[0] * fine.n[1])};
            int lower[3], ends[3];
            for (int k = 0; k < 3; ++k) {
                lower[k] = at[k] / own.factor[k];
                ends[k] = 1 + at[k] % own.factor[k];
            }
            T total = T(0);
            for (int c = 0; c < ends[2]; ++c)
            for (int b = 0; b < ends[1]; ++b)
            for (int a = 0; a < ends[0]; ++a) {
                const int x = wrapped(lower[0] + a, own.n[0]), y = wrapped(lower[1] + b, own.n[1]);
                total += z[(wrapped(lower[2] + c, own.n[2]) * own.n[1] + y) * own.n[0] + x];
            }
            return total / T(ends[0] * ends[1] * ends[2]);
        };
        auto smoothed = [&](const Level& own, int i, const T* r, const T* x) -> T {
            const T w = of(system.weight, own)[i];
            return w > T(0) ? x[i] + w * (r[i] - product(own, i, [&](int j) { return x[j]; })) : T(0);
        };
        auto cycle = [&]() -> T {
            for (int l = 0; l + 1 < levels; ++l) {
                const Level own = level(l), coarser = level(l + 1);
                const T *w = of(system.weight, own), *r = of(system.residual, own);
                T *left = of(system.x_values, own), *down = of(system.residual, coarser);
                each(alone(l), own.nodes, [&](int i) {
                    left[i] = w[i] > T(0) ? r[i] - product(own, i, [&](int j) { return w[j] * r[j]; }) : T(0);
                });
                each(alone(l), coarser.nodes, [&](int i) { down[i] = restricted(own, coarser, i, left); });
            }
            const Level last = level(levels - 1);
            T *x = of(system.x_values, last), *z = of(system.z_values, last);
            const T *w = of(system.weight, last), *r = of(system.residual, last);
            each(alone(levels - 1), last.nodes, [&](int i) { x[i] = w[i] * r[i]; });
            if (levels == 1) return sum(last.nodes, [&](int i) { z[i] = smoothed(last, i, r, x); return z[i] * r[i]; });
            each(alone(levels - 1), last.nodes, [&](int i) { z[i] = smoothed(last, i, r, x); });
            for (int l = levels - 2; ; --l) {
                if (alone(l + 1) && !alone(l)) meet();
                const Level own = level(l), coarser = level(l + 1);
                const T *w = of(system.weight, own), *r = of(system.residual, own), *up = of(system.z_values, coarser);
                T *x = of(system.x_values, own), *z = of(system.z_values, own);
                each(alone(l), own.nodes, [&](int i) {
                    x[i] = w[i] > T(0) ? w[i] * r[i] + prolonged(own, coarser, i, up) : T(0);
                });
                if (l == 0) return sum(own.nodes, [&](int i) { z[i] = smoothed(own, i, r, x); return z[i] * r[i]; });
                each(alone(l), own.nodes, [&](int i) { z[i] = smoothed(own, i, r, x); });
            }
        };

        const Level own = level(0);
        const T *w = of(system.weight, own), *z = of(system.z_values, own);
        T *r = of(system.residual, own), *p = of(system.direction, own), *q = of(system.image, own), *y = of(e, own);
        T size = cycle();
        const T enough = tolerance * tolerance * size;
        int done = 0;
        each(false, own.nodes, [&](int i) { y[i] = T(0); p[i] = z[i]; });
        while (size > T(0)) {
            T curvature = sum(own.nodes, [&](int i) {
                q[i] = w[i] > T(0) ? product(own, i, [&](int j) { return p[j]; }) : T(0);
                return p[i] * q[i];
            });
            for (int row = 0; row < system.rows; ++row) {
                const T* b = system.B.data + ((long long)row * system.members + member) * own.nodes;
                meet();
                const T along = sum(own.nodes, [&](int i) { return b[i] * p[i]; });
                each(false, own.nodes, [&](int i) { q[i] += along * b[i]; });
                curvature += along * along;
            }
            const T step = size / curvature;
            each(false, own.nodes, [&](int i) { y[i] += step * p[i]; r[i] -= step * q[i]; });
            const T next = cycle();
            if (++done >= most || !(next > enough)) break;
            const T turn = next / size;
            size = next;
            each(false, own.nodes, [&](int i) { p[i] = z[i] + turn * p[i]; });
        }
        if (lead) system.count.data[member] = done;
    }
"""
"""C++ code of a solve. The solve sets the result of nodes without matrix entries to 0."""


@cache
def system_type(precision: Precision) -> Any:
    """Make the Warp struct of the equations: matrices and work arrays of all levels, one level after the other."""
    numbers = wp.array(dtype=precision.real)

    @wp.struct
    class System:
        shapes: wp.array(dtype=wp.int32)
        """Six numbers for each level: numbers of nodes along the axes, and ratios to the finer level."""
        starts: wp.array(dtype=wp.int64)
        members: wp.int32
        team: wp.int32
        A: numbers
        weight: numbers
        residual: numbers
        x_values: numbers
        z_values: numbers
        direction: numbers
        image: numbers
        rows: wp.int32
        B: numbers
        """Rows of the matrix of rigid bodies, one after the other."""
        partial: numbers
        gate: wp.array(dtype=wp.int32)
        """Number of waiting blocks and number of passed barriers, for each team of blocks."""
        count: wp.array(dtype=wp.int32)
        """Number of iterations of the last solve in each scene (members,)."""

    return System


@cache
def solve_kernel(precision: Precision, dimension: int, is_cpu: bool) -> Any:
    real, system_kind = precision.real, system_type(precision)
    module = kernel_module(f"coarse_solve_{dimension}d_{precision.name}" + ("" if is_cpu else "_blocks"))
    text = f"typedef wp::{real.__name__} T;\n" + (ON_A_CPU if is_cpu else ON_A_GPU) + SOLVE
    numbers = {"BLOCK": BLOCK, "ALONE": ALONE, "AROUND": 3**dimension, "FLAT": dimension == 2}
    for word, value in numbers.items():
        text = text.replace(word, str(int(value)))

    @wp.func_native(text)
    def solve_all(thread: wp.int32, system: system_kind, tolerance: real, most: wp.int32, e: wp.array(dtype=real)): ...

    bounds = None if is_cpu else (BLOCK, 1)  # so that registers suffice for a block; 3 to 9 % less time for a solve

    @wp.kernel(module=module, enable_backward=False, grid_stride=False, launch_bounds=bounds)
    def solve(system: system_kind, tolerance: real, most: int, e: wp.array(dtype=real)):
        solve_all(wp.tid(), system, tolerance, most, e)

    if not is_cpu:
        module.options["block_dim"] = BLOCK
    return solve
