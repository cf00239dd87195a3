// Images of the fluid in flat walls that mirror it: what one of them mirrors, or two or three that meet. Seen from
// particle i, the image of j is where the image of i sees j, so that all images that i can see are of its neighbours, or
// its own. docs/projection.md says what they do.
#pragma once

#include "model.hpp"

namespace cortado {

// A pair of a particle and an image.
template <class Scalar, int D>
struct Image : Pair<Scalar, D> {
    Vector<Scalar, D> flip;    // what the reflection does to a vector
    Vector<Scalar, D> direct;  // the separation from the particle that it mirrors

    Vector<Scalar, D> of(const Vector<Scalar, D>& v) const { return flip.cwiseProduct(v); }
};

// A bit for each wall that mirrors and that x is in front of: a wall mirrors nothing else.
template <class Scalar, int D>
int before_mirrors(const Model<Scalar, D>& model, const Vector<Scalar, D>& x) {
    using Real = typename RealOf<Scalar>::type;
    int before = 0;
    for (int axis = 0; axis < D; ++axis) {
        const Real place = real_part(x[axis]);
        if (place >= Real(model.mirror_lower[axis])) before |= 1 << axis;
        if (place <= Real(model.mirror_upper[axis])) before |= 1 << (D + axis);
    }
    return before;
}

// `body(image)` for all images that particle i sees, at positions x, of those within reach where the list begins.
template <class Scalar, int D, class Body>
void each_image(const Model<Scalar, D>& model, const Pairs<Scalar, D>& fluid, const Vectors<Scalar, D>& x,
                std::size_t i, const Body& body) {
    using Real = typename RealOf<Scalar>::type;
    const Vectors<Scalar, D>& start = fluid.start();
    const Real reach_squared = Real(model.reach) * Real(model.reach);
    int near = 0;  // a bit for each wall within reach: those at lower ends first
    for (int axis = 0; axis < D; ++axis) {
        const Real place = real_part(start[i][axis]);
        if (place - Real(model.mirror_lower[axis]) < Real(model.reach)) near |= 1 << axis;
        if (Real(model.mirror_upper[axis]) - place < Real(model.reach)) near |= 1 << (D + axis);
    }
    near &= before_mirrors(model, start[i]);
    for (int code = 1; code <= near; ++code) {
        if ((code & near) != code || (code & (code >> D)) != 0) continue;
        Vector<Scalar, D> flip = Vector<Scalar, D>::Constant(Scalar(1)), offset = flip - flip;
        for (int axis = 0; axis < D; ++axis) {
            const bool lower = code >> axis & 1, upper = code >> (D + axis) & 1;
            if (!lower && !upper) continue;
            flip[axis] = Scalar(Real(-1));
            offset[axis] = Scalar(Real(2) * Real(lower ? model.mirror_lower[axis] : model.mirror_upper[axis]));
        }
        const auto visit = [&](int j) {
            if ((code & before_mirrors(model, start[j])) != code) return;
            const auto apart = [&](const Vectors<Scalar, D>& at) -> Vector<Scalar, D> {
                const Vector<Scalar, D> mirrored = flip.cwiseProduct(at[j]) + offset;
                return model.period.nearest(at[i] - mirrored);
            };
            const Vector<Scalar, D> then = apart(start), x_ij = apart(x);
            const Scalar r_squared = x_ij.dot(x_ij);
            if (!(real_part(then.dot(then)) < reach_squared) || !model.smoothing.near(r_squared)) return;
            const Scalar q = model.smoothing.q_of(r_squared);
            Image<Scalar, D> image;
            image.other = j;
            image.x = x_ij;
            image.w = model.smoothing.weight(q);
            image.a = model.smoothing.slope(q);
            image.b = model.smoothing.bend(q);
            image.flip = flip;
            image.direct = model.period.nearest(x[i] - x[j]);
            body(image);
        };
        for (auto pair = fluid.begin_of(i); pair != fluid.end_of(i); ++pair) visit(pair->other);
        visit(int(i));
    }
}

// `body(b, pair)` for all particles of walls that mirror, at positions x over a list.
template <class Scalar, int D, class Body>
void each_mirror(const Model<Scalar, D>& model, const Pairs<Scalar, D>& walls, const Vectors<Scalar, D>& x,
                 std::size_t i, const Body& body) {
    for (auto pair = walls.begin_of(i); pair != walls.end_of(i); ++pair) {
        if (!model.wall_mirrors[pair->other]) continue;
        Pair<Scalar, D> now = *pair;
        now.x = model.period.nearest(x[i] - model.wall_positions[pair->other].template cast<Scalar>());
        const Scalar r_squared = now.x.dot(now.x);
        if (!model.smoothing.near(r_squared)) continue;
        const Scalar q = model.smoothing.q_of(r_squared);
        now.w = model.smoothing.weight(q);
        now.a = model.smoothing.slope(q);
        body(now);
    }
}

// sum V W of images less that of the walls that mirror, by which n differs where images count wholly.
template <class Scalar, int D>
Scalar surplus(const Model<Scalar, D>& model, const Pairs<Scalar, D>& fluid, const Pairs<Scalar, D>& walls,
               const Vectors<Scalar, D>& x, std::size_t i) {
    Scalar total(0);
    each_image(model, fluid, x, i, [&](const Image<Scalar, D>& image) { total += image.w; });
    each_mirror(model, walls, x, i,
                [&](const Pair<Scalar, D>& wall) { total -= model.wall_weights[wall.other] * wall.w; });
    return model.volume * total;
}

// Its tangent.
template <class Real, int D>
Real surplus_tangent(const Model<Real, D>& model, const Pairs<Real, D>& fluid, const Pairs<Real, D>& walls,
                     const Vectors<Real, D>& x, const Vectors<Real, D>& dx, std::size_t i) {
    Real total = 0;
    each_image(model, fluid, x, i, [&](const Image<Real, D>& image) {
        total += image.gradient().dot(dx[i] - image.of(dx[image.other]));
    });
    each_mirror(model, walls, x, i, [&](const Pair<Real, D>& wall) {
        total -= model.wall_weights[wall.other] * wall.gradient().dot(dx[i]);
    });
    return model.volume * total;
}

// sum (c_i + c_j) g_ij' over images: what an adjoint c of each sum of V W gives to the position of particle i.
template <class Scalar, int D>
Vector<Scalar, D> lift(const Model<Scalar, D>& model, const Pairs<Scalar, D>& fluid, const Vectors<Scalar, D>& x,
                       const Values<Scalar>& c, std::size_t i) {
    Vector<Scalar, D> total = Vector<Scalar, D>::Constant(Scalar(0));
    each_image(model, fluid, x, i,
               [&](const Image<Scalar, D>& image) { total += (c[i] + c[image.other]) * image.gradient(); });
    return model.volume * total;
}

// sum (v_i - R v_j) . g_ij' over images.
template <class Scalar, int D>
Scalar widening(const Model<Scalar, D>& model, const Pairs<Scalar, D>& fluid, const Vectors<Scalar, D>& x,
                const Vectors<Scalar, D>& v, std::size_t i) {
    Scalar total(0);
    each_image(model, fluid, x, i, [&](const Image<Scalar, D>& image) {
        total += image.gradient().dot(v[i] - image.of(v[image.other]));
    });
    return model.volume * total;
}

}  // namespace cortado
