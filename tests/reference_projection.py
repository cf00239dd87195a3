"""Slow twin of a step of the projection: all pairs, NumPy, straight from the equations of `docs/projection_step.md`."""

import itertools
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

import reference
from cortado.discretise.smoothing import SKIN


def between(H, first, second):
    t = np.clip((H - first) / (second - first), 0.0, 1.0)
    return 3 * t**2 - 2 * t**3


@dataclass(frozen=True)
class Body:
    """A free body that begins at rest."""

    walls: np.ndarray
    """Which wall particles are its own."""
    middle: np.ndarray
    mobility: np.ndarray
    """(6, 6) velocity and angular velocity for momentum and angular momentum, in volumes of a particle: P (P^T M P)^-1
    P^T for the ways P in which it is free."""
    mass: float
    """In volumes of a particle."""
    bounds: tuple[float, float]
    """Of both halves of the mobility."""

    @classmethod
    def of(cls, held, solids, scene):
        """Of one of the solver, in its scene."""
        table, d, mass = held.body.table, scene.dimension, held.body.table.mass
        solid = next(one for one in scene.solid if one.name == table.name)
        turn, inverse = np.eye(3), np.linalg.pinv(mass.inertia)
        turn[:d, :d] = solid.turn(d)
        whole = solid.density * np.kron(np.diag([1.0, 0.0]), mass.volume * np.eye(3))
        whole[3:, 3:] = solid.density * turn @ mass.inertia @ turn.T
        ways = cls.ways(table.hold, turn)
        mobility = ways @ np.linalg.pinv(ways.T @ whole @ ways) @ ways.T
        goes, turns = (np.abs(half).any() for half in (mobility[:3], mobility[3:]))
        bounds = goes / mass.volume / solid.density, turns * np.linalg.eigvalsh(inverse).max() / solid.density
        return cls(solids == table.number, np.array(solid.middle()), mobility, whole[0, 0], bounds)

    @staticmethod
    def ways(hold, turn):
        """(6, ways) the velocity and the angular velocity of each way that is free."""
        axis, across = np.array(hold.axis), -turn @ hold.arm
        kept = {0: np.zeros((3, 3)), 1: np.outer(axis, axis), 2: np.eye(3) - np.outer(axis, axis), 3: np.eye(3)}
        turns = kept[hold.turning]
        return np.block([[np.diag(hold.moving), np.cross(turns, across).T], [np.zeros((3, 3)), turns]])

    def rows(self, gamma, x):
        arm, force = (np.pad(a, ((0, 0), (0, 3 - a.shape[1]))) for a in (x - self.middle, gamma))
        return np.hstack([force, np.cross(arm, force)]).T

    def falling(self, gravity, d, dt):
        """(6,) what gravity adds to its motion in a step."""
        return self.mobility[:, :d] @ np.broadcast_to(gravity, d) * (self.mass * dt)

    def diagonal(self, rows):
        force, torque = np.linalg.norm(rows[:3], axis=0), np.linalg.norm(rows[3:], axis=0)
        return self.bounds[0] * force * force.sum() + self.bounds[1] * torque * torque.sum()


@dataclass(frozen=True)
class Face:
    """A flat face of a solid that moves in the plane, where it is at the end of a step."""

    walls: np.ndarray
    """Which wall particles are behind it."""
    place: np.ndarray
    normal: np.ndarray
    half: float
    """Half its length."""
    matrix: np.ndarray
    """Q and c_0 - Q c of the way back to the start of the step, x -> Q x + c_0 - Q c."""
    shift: np.ndarray

    @classmethod
    def all_of(cls, simulation):
        search, faces = simulation.solver.search, simulation.solver.system.faces
        walls, found = search.walls["wall_faces"].numpy(), []
        for f, k in enumerate(faces.solids):
            c, R, c_0, R_0 = (
                search.moving.named[name].numpy()[0, k] for name in ("after", "turns", "before", "turns_before")
            )
            Q, scale = R_0 @ R.T, search.moving.named["scales"].numpy()[0, k]
            place, normal = c + scale * R @ faces.places[f], R @ faces.frames[f][0]
            own = (walls == f, place[:2], normal[:2], scale * faces.sizes[f][1])
            found.append(cls(*own, Q[:2, :2], (c_0 - Q @ c)[:2]))
        return tuple(found)

    @property
    def reflection(self):
        return np.eye(2) - 2 * np.outer(self.normal, self.normal), 2 * self.normal @ self.place * self.normal

    def heights(self, x):
        """How far positions are in front of it, infinite where they are not."""
        height, along = (x - self.place) @ self.normal, (x - self.place) @ [self.normal[1], -self.normal[0]]
        return np.where((height >= 0) & (np.abs(along) < self.half), height, np.inf)

    def swept(self, x):
        """How far the step takes images of positions."""
        (R, offset), back = self.reflection, np.eye(2) - self.matrix
        return ((x @ R + offset) @ back.T - self.shift) - (x @ back.T - self.shift) @ R


@dataclass(frozen=True)
class Projection:
    """Of a scene without forces but gravity."""

    kernel: object
    support: float
    volume: float
    spacing: float
    walls: np.ndarray
    wall_weights: np.ndarray
    feet: np.ndarray
    """From wall particles to the surface."""
    mirrors: tuple[np.ndarray, np.ndarray]
    """Coordinates of flat walls that mirror the fluid; infinite where none does."""
    container: np.ndarray
    """Which wall particles are theirs."""
    periods: np.ndarray
    iterations: int
    repairs: int
    follow: bool
    nodes: tuple[np.ndarray, np.ndarray, np.ndarray]
    """Of the coarse grid: the place of the first node, 1 / the distance of two, and how many there are, along each
    axis."""
    bodies: tuple[Body, ...] = ()
    """Free ones: their walls are where the last step of the simulation had them, as are those of other solids."""
    velocities: np.ndarray | float = 0.0
    """Of wall particles."""
    faces: tuple[Face, ...] = ()

    @classmethod
    def of(cls, simulation):
        """Beside the walls of a simulation."""
        solver, scene, d = simulation.solver, simulation.scene, simulation.dimension
        search, lattice = solver.search, solver.lattice
        walls = (
            search.walls["wall_positions"].numpy()[:, :d],
            search.walls["wall_weights"].numpy(),
            search.walls["wall_feet"].numpy()[:, :d],
        )
        kernel, spacing = solver.discretisation.smoothing, scene.discretisation.spacing
        periods = np.array(scene.container.periods(d)[1])
        counts = (getattr(scene.solver, name, 2) for name in ("iterations", "repairs"))
        follow = getattr(scene.solver, "velocities_follow", False)
        grid = solver.coarse.grid["grid"]
        nodes = tuple(np.array([*map(float, part)])[:d] for part in (grid.origin, grid.frequency, grid.shape))
        held, solids = getattr(solver.bodies, "held", ()), search.walls["wall_solids"].numpy()
        bodies = tuple(Body.of(one, solids, scene) for one in held)
        nodes = None if solver.coarse.endless else nodes
        mirrors = tuple(end[:d] for end in solver.system.mirrors)
        walls = (*walls, mirrors, (solids == -1) & np.isfinite(mirrors).any())
        moving = search.walls["wall_velocities"].numpy()[:, :d], Face.all_of(simulation)
        own = kernel, lattice.support, lattice.volume, spacing
        return cls(*own, *walls, periods, *counts, follow, nodes, bodies, *moving)

    def pairs(self, x, y):
        """Separations (n, m, d), and V W and V grad W of them."""
        d = x.shape[1]
        apart = x[:, None] - y[None, :]
        turns = np.where(self.periods > 0, np.round(apart / np.where(self.periods > 0, self.periods, 1)), 0)
        apart = apart - turns * self.periods
        q = np.sqrt((apart**2).sum(-1)) / self.support
        sigma = self.kernel.normalisation(d, self.support)
        W = self.volume * sigma * reference.value(self.kernel.name, q)
        a = self.volume * sigma / self.support**2 * reference.slope(self.kernel.name, q)
        return apart, W, a[..., None] * apart

    def images(self, x, before=None):
        """Of each reflection what it does to vectors, the separations from images, and V W and V grad W of them, of
        what is in front of its walls at positions before a step, and how far a step takes images."""
        before, (lower, upper) = x if before is None else before, self.mirrors
        ways = [
            [(1, 0, 0), *((-1, 2 * end, side) for end, side in ((low, 1), (high, -1)) if np.isfinite(end))]
            for low, high in zip(lower, upper, strict=True)
        ]
        for way in itertools.product(*ways):
            flip, offset, side = np.array(way, dtype=float).T
            if (flip < 0).any():
                front = (side * (before - offset / 2) >= 0).all(axis=1)
                both = front[:, None] & front[None, :]
                apart, W, g = self.pairs(x, flip * x + offset)
                yield np.diag(flip), apart, W * both, g * both[..., None], 0.0 * x
        for face in self.faces:
            R, offset = face.reflection
            front = np.isfinite(face.heights(before))
            both = front[:, None] & front[None, :]
            apart, W, g = self.pairs(x, x @ R + offset)
            yield R, apart, W * both, g * both[..., None], face.swept(x)

    def mirroring(self, x):
        """(n, b) which wall particles mirror about which position: those of the container, and of the nearest face."""
        reach, found = (1 + SKIN) * self.support, np.tile(self.container, (len(x), 1))
        heights = np.array([face.heights(x) for face in self.faces] or [np.full(len(x), np.inf)])
        for f, face in enumerate(self.faces):
            found |= ((heights.argmin(0) == f) & (heights[f] < reach))[:, None] & face.walls
        return found

    def share(self, x):
        """h, of walls that mirror the push and nu, and how far others are away."""
        _, wall_W, wall_g = self.pairs(x, self.walls)
        own, all_W = self.mirroring(x), wall_W * self.wall_weights
        alone = 1 / (1 + ((all_W * ~own).sum(1) / 0.005) ** 4)
        mirror, behind = self.pushes(wall_g, own)[0], (all_W * own).sum(1)
        images = sum((W.sum(1) for _, _, W, *_ in self.images(x)), np.zeros(len(x)))
        return between(images / (behind + 1e-6), 0.7, 0.9) * alone, mirror, behind, alone

    def density(self, x, h, before=None):
        """Over the neighbours and images that particles have at positions before a step, images h times."""
        before, reach = x if before is None else before, (1 + SKIN) * self.support

        def listed(W, apart):
            return (W * (np.linalg.norm(apart, axis=-1) < reach)).sum(1)

        wall = self.pairs(x, self.walls)[1] * (1 - h[:, None] * self.mirroring(x)) * self.wall_weights
        found = listed(self.pairs(x, x)[1], self.pairs(before, before)[0])
        found += listed(wall, self.pairs(before, self.walls)[0])
        for now, then in zip(self.images(x, before), self.images(before), strict=True):
            found += h * listed(now[2], then[1])
        return found

    @cached_property
    def constants(self):
        """omega and a_0 of the lattice."""
        d = self.walls.shape[1]
        reach, steps = np.arange(-5, 6) * self.spacing, np.linspace(0, np.pi / self.spacing, 25)
        lattice, waves = (np.stack(np.meshgrid(*[a] * d, indexing="ij"), -1).reshape(-1, d) for a in (reach, steps))
        g = replace(self, periods=np.zeros(d)).pairs(np.zeros((1, d)), lattice)[2][0]
        square, near = (g**2).sum(), g.any(1)
        return 1 / (1.05 * ((np.sin(waves @ lattice[near].T) @ g[near]) ** 2).sum(1).max() / square), square

    def around(self, x):
        """W, g, the sum of g, gamma, nu, M, H and the inverse of M."""
        d, (apart, W, g) = x.shape[1], self.pairs(x, x)
        _, wall_W, wall_g = self.pairs(x, self.walls)
        (gamma, whole), least = self.pushes(wall_g), 5e-4 * self.constants[1]
        off = ((whole**2).sum(1) - (gamma**2).sum(1)) / ((whole**2).sum(1) + least)
        gamma = gamma + between(off, 0.1, 0.4)[:, None] * (whole - gamma)
        nu = wall_W @ self.wall_weights
        M = -np.einsum("ija,ijb->iab", g, apart)
        if d == 2:
            H = 2 * np.linalg.det(M) / (np.trace(M, axis1=1, axis2=2) + 1e-12)
        else:
            squares = (np.trace(M, axis1=1, axis2=2) ** 2 - np.trace(M @ M, axis1=1, axis2=2)) / 2
            H = 3 * np.linalg.det(M) / (squares + 1e-12)
        return W, g, g.sum(1), gamma, nu, M, H, 1.05 * np.linalg.inv(M + 0.05 * np.eye(d))

    def pushes(self, wall_g, own=True):
        """gamma_n and gamma_w, of all wall particles or of a body's ``own``."""
        normal = self.feet / np.linalg.norm(self.feet, axis=1, keepdims=True)
        weights = np.broadcast_to(self.wall_weights * own, wall_g.shape[:2])
        return np.einsum("ib,iba,ba,bc->ic", weights, wall_g, normal, normal), np.einsum("ib,iba->ia", weights, wall_g)

    def drift(self, x, h, dt):
        """By walls that move, of whose share h images stand for."""
        g, normal = self.pairs(x, self.walls)[2], self.feet / np.linalg.norm(self.feet, axis=1, keepdims=True)
        v = np.broadcast_to(self.velocities, self.walls.shape)
        parts = np.einsum("iba,ba,bc,bc->ib", g, normal, normal, v) * self.wall_weights
        wholes = np.einsum("iba,ba->ib", g, v) * self.wall_weights
        (gamma, whole), least = self.pushes(g), 5e-4 * self.constants[1]
        e = between(((whole**2).sum(1) - (gamma**2).sum(1)) / ((whole**2).sum(1) + least), 0.1, 0.4)
        found = (1 - e) * parts.sum(1) + e * wholes.sum(1) - h * (parts * self.mirroring(x)).sum(1)
        return found + h * sum(np.einsum("ija,ja->i", g, swept) / dt for *_, g, swept in self.images(x))

    def body_rows(self, x):
        wall_g, least = self.pairs(x, self.walls)[2], 5e-4 * self.constants[1]
        (normal, whole) = self.pushes(wall_g)
        off = ((whole**2).sum(1) - (normal**2).sum(1)) / ((whole**2).sum(1) + least)
        e, found = between(off, 0.1, 0.4)[:, None], []
        for body in self.bodies:
            normal, whole = self.pushes(wall_g, body.walls)
            found.append(body.rows(normal + e * (whole - normal), x))
        return found

    def step(self, x, v_star, before, m, dt, gravity=0.0):
        """Positions, velocities, and k with what it adds to velocities, after the step, from predicted velocities and
        those two of the step before; and the divergence that the last iteration found, times the step. Bodies begin at
        rest and fall with the ``gravity``."""
        (n, d), (h, mirror, behind, alone) = x.shape, self.share(x)
        density = self.density(x, h)
        _, g, total, walled, nu, M, H, inverse = self.around(x)
        B, Bo = (1 / (1 + (each / 0.05) ** 4) for each in (nu + 9 * alone * behind, nu - alone * behind))
        gamma = walled - alone[:, None] * mirror
        tension = between(H, 0.1, 0.5) * B
        omega, square = self.constants
        N = gamma[:, :, None] * gamma[:, None, :]
        N = N / ((gamma**2).sum(1) + 0.01 * 0.05 * square)[:, None, None]
        P = np.eye(d) - N
        across = P @ M @ N
        C = 1.05 / ((M * N).sum((1, 2)) + 0.05)[:, None, None] * (across + across.transpose(0, 2, 1))
        K = inverse + 0.033 * between(H, 0.8, 0.95)[:, None, None] * (inverse @ (inverse - np.eye(d)))
        t = 0.2 * (1.05 / ((M * P).sum((1, 2)) / (d - 1) + 0.05) - 1)[:, None, None]
        beside = t * P - (1 + t) * C
        inside, Bo, full = B[:, None, None], Bo[:, None, None], between(H + nu, 0.1, 0.5)
        L = np.eye(d) + between(H, 0.2, 0.5)[:, None, None] * (inside * (K - np.eye(d)) + (1 - Bo) * beside)
        own = np.einsum("iab,ib->ia", L, total) + walled
        gamma = walled - h[:, None] * mirror
        images = [(R, g_image) for R, _, _, g_image, _ in self.images(x)]
        a = ((own**2).sum(1) + 0.05 * square) / m
        unequal = 1 + 2 * ((m[:, None] - m) / (m[:, None] + m)) ** 2
        a += (unequal * (np.einsum("iab,ijb->ija", L, g) ** 2).sum(-1)) @ (1 / m)
        rows = self.body_rows(x)
        yielding = np.zeros((n, n))
        for body, row in zip(self.bodies, rows, strict=True):
            a += body.diagonal(row)
            yielding += row.T @ body.mobility @ row
        falls = self.drift(x, h, dt)
        for body, row in zip(self.bodies, rows, strict=True):
            falls = falls + row.T @ body.falling(gravity, d, dt)

        def lift(k):
            both = (h * k)[:, None] + (h * k)[None, :]
            return sum((np.einsum("ij,ija->ia", both, image) for _, image in images), np.zeros((n, d)))

        def force(k):
            pull = k[:, None, None] * L
            from_fluid = np.einsum("iab,ijb->ia", pull, g) + np.einsum("jab,ijb->ia", pull, g)
            return from_fluid + k[:, None] * gamma + lift(k)

        def divergence(v):
            apart = v[:, None] - v[None, :]
            found = np.einsum("iab,ija,ijb->i", L, apart, g) + (gamma * v).sum(1)
            for R, image in images:
                found = found + h * np.einsum("ija,ija->i", v[:, None] - (v @ R)[None, :], image)
            return found

        share = between(H + 2 * nu, 0.7, 0.95)
        if (share > 0).all():
            tension = np.ones(n)
        correct = self.coarse(x, m, force(share), L, g, share, h, yielding) if self.nodes else None
        wanted = (1 - full) * np.maximum(1 - density, 0) / dt
        far = dt * np.linalg.norm(before[1], axis=1) > 0.1 * self.spacing
        taken = np.where(far & ((before[1] * walled).sum(1) > 0), 0, full)
        k = y = taken * before[0]
        v = v_star + taken[:, None] * before[1]
        momentum = 4 / ((1 + np.sqrt(101)) / 2)
        for left in reversed(range(self.iterations)):
            if correct is not None and (left < self.iterations - 1 or not (k > 0).any()):
                r = divergence(v) - falls - yielding @ y - wanted
                r = np.where((y > 0) | (tension == 1), r, between(dt * r, -1e-6, 1e-6) * r)
                z = y + correct(r)
                least = np.minimum(y, 0)
                change = np.where(z > least, z, least + tension * (z - least)) - y
                thrust = -force(change) / m[:, None]
                energy = (m[:, None] * thrust**2).sum() + change @ yielding @ change
                least = (m * (1e-6 * self.spacing / dt) ** 2).sum()
                some = least if left < self.iterations - 1 else 0.0
                alpha = np.clip(((r * change).sum() + some) / (energy + least), 0, 1)
                k = y = y + alpha * change
                v = v + alpha * thrust
            u, D = v, divergence(v) - falls - yielding @ y
            up, down = y + omega * (D - wanted) / a, y + omega * D / a
            new = np.where(up > 0, up, np.where(down < 0, tension * down, 0))
            missed = dt * np.where(up > 0, D - wanted, np.where(down < 0, tension * D, 0))
            y, k, momentum = new + momentum * (new - k), new, 0
            kick = -force(y) / m[:, None]
            v = v_star + kick
        moved = x + dt * v + self.shift(x, u, dt, dt * k / m)
        now, c = moved, np.zeros(n)
        low = between(H, 0.8, 0.95) * B
        for root in np.cos(np.pi * (2 * np.arange(self.repairs) + 1) / (2 * self.repairs)):
            z = c + omega * 3 / (2 - root) * (self.density(now, h, x) - 1) / a
            c = np.where(z > 0, z, low * z)
            back = (((c[:, None] + c[None, :])[..., None] * g).sum(1) + c[:, None] * gamma + lift(c)) / m[:, None]
            now = moved - back / np.maximum(np.linalg.norm(back, axis=1) / (self.spacing / 6), 1)[:, None]
        if self.follow:
            slopes = -np.einsum("ija,ijb,ibc->iac", u[:, None] - u[None, :], g, inverse)
            v = v + np.einsum("iab,ib->ia", slopes, now - x - dt * v)
        share = between(H + 2 * nu, 0.7, 0.95)
        return now, v, (k, kick), np.sqrt((share * missed**2).sum() / share.sum())

    def coarse(self, x, m, push, L, g, c, h, yielding):
        """The function that gives the coarse pressure of a residual, from hat functions written out node by node."""
        (first, frequency, counts), (n, d) = self.nodes, x.shape
        shape = counts.astype(int)
        s, lattice = (x - first) * frequency, 8 / 3 * {2: 1.0, 3: 2.0}[d] / self.spacing**2
        cell, t = np.floor(s).astype(int), s - np.floor(s)
        phi, slope, touched = np.zeros((n, shape.prod())), np.zeros((n, shape.prod(), d)), np.zeros(shape.prod())
        for corner in np.ndindex(*[2] * d):
            node = np.ravel_multi_index(((cell + corner) % shape).T, shape)
            weight, sign = np.where(corner, t, 1 - t), np.where(corner, 1, -1) * frequency
            phi[np.arange(n), node] += weight.prod(1)
            np.add.at(touched, node, (lattice / 4**d * 1e-5 + 0.01 * (push**2).sum(1)) / m)
            for axis in range(d):
                others = np.delete(weight, axis, 1).prod(1)
                slope[np.arange(n), node, axis] += sign[axis] * others
        apart = self.pairs(x, x)[0]
        moment = np.einsum("j,jab,ijb,ijk->iak", c, L, g, -apart)
        moment += sum(np.einsum("j,ija,ijk->iak", h * c, image, -apart) for *_, image, _ in self.images(x))
        q = np.einsum("iab,iIb->iIa", moment, slope) + phi[:, :, None] * push[:, None, :]
        A = np.einsum("iIa,iJa,i->IJ", q, q, 1 / m) + np.diag(touched)
        A += (phi.T * c) @ yielding @ (phi.T * c).T
        live = touched > 0

        def correct(r):
            e = np.zeros(len(touched))
            e[live] = np.linalg.solve(A[np.ix_(live, live)], (phi.T @ (c * r))[live])
            return c * (phi @ e)

        return correct

    def shift(self, x, v, dt, pull=0.0):
        """By velocities, and dt^2 p / rho of every particle."""
        (W, g, total, gamma, nu, _, H, inverse), s, d = self.around(x), self.spacing, x.shape[1]
        _, _, behind, alone = self.share(x)
        gradient = np.einsum("ija,ijb,ibc->iac", v[:, None] - v[None, :], g, inverse)
        rate = 20 * (np.sqrt(dt**2 * (gradient**2).sum((1, 2)) + 1e-10) - 1e-5)
        c = between(H, 0.8, 0.95) / (1 + ((nu + 9 * alone * behind) / 0.05) ** 4) * np.maximum(-pull, 0.0) / s**2
        rate = rate + 60 * c**2 / (c + 0.004) ** 1.5
        near = self.volume * self.kernel.weight(np.array([s]), d, self.support)[0]
        close = (W / near) ** 4
        slope = ((1 + 0.25 * close / (1 + close / 4))[..., None] * g).sum(1) + gamma
        out = total + gamma
        along = slope - out * ((out * slope).sum(1) / ((out**2).sum(1) + (0.03 / s) ** 2))[:, None]
        strength = rate / np.sqrt(1 + (rate / 0.5) ** 2)
        apart = self.pairs(x, x)[0]
        away = (np.maximum(1 - (apart**2).sum(-1) / (0.65 * s) ** 2, 0)[..., None] ** 2 * apart).sum(1)
        wish = strength[:, None] * (4 * away - (s**2 * between(H, 0.5, 0.8))[:, None] * along)
        return wish / np.sqrt(1 + (wish**2).sum(1) / (0.1 * s) ** 2)[:, None]
