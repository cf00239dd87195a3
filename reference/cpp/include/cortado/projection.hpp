// The projection, from predicted velocities to the result of a step: pressures that make velocities free of divergence,
// a shift, and the repair of density, with every intermediate value that derivatives need. docs/projection.md writes
// the same in the same order.
#pragma once

#include <algorithm>

#include "coarse.hpp"

namespace cortado {

// How much of the slopes of z+ and of sigma z- the clamp has: all of one of them, or on a corner the mean of both
// sides.
template <class Scalar>
struct Clamp {
    Scalar rise{0}, fall{0};

    Clamp(const Scalar& up, const Scalar& down) {
        using Real = typename RealOf<Scalar>::type;
        const Real above = real_part(up), below = real_part(down), half = Real(1) / Real(2);
        rise = Scalar(above > Real(0) ? Real(1) : above == Real(0) ? half : Real(0));
        if (above <= Real(0)) fall = Scalar(below < Real(0) ? Real(1) : below == Real(0) ? half : Real(0));
    }
};

template <class Scalar, int D>
struct Projection {
    using Real = typename RealOf<Scalar>::type;

    std::vector<Moments<Scalar, D>> moments;
    std::vector<Effects<Scalar, D>> effects;
    Values<Scalar> n;                         // the number density, with images
    std::vector<Values<Scalar>> k, y;         // [i]: before iteration i; the last of each is the result
    std::vector<Values<Scalar>> divergences;  // [i]: the divergence that iteration i finds
    std::vector<Vectors<Scalar, D>> u;        // [i]: the velocity before iteration i; the last is the result
    std::vector<Correction<Scalar, D>> corrections;  // [i]: of k, y and u before iteration i, where one is due
    Coarse<Scalar, D> coarse;
    Vectors<Scalar, D> kick;                  // what the last k adds to velocities
    Matrices<Scalar, D> A;                    // sum v_ij g_ij^T of the last but one
    Vectors<Scalar, D> crowd, apart;          // sum (1 + q_ij / (4 + q_ij)) g_ij, sum p_ij
    Vectors<Scalar, D> x_moved;               // x'
    std::vector<Vectors<Scalar, D>> x_now;    // [i]: before repair i; the last is the result
    std::vector<Values<Scalar>> c;            // [i]: lambda before repair i
    std::vector<Values<Scalar>> excess;       // [i]: n - 1 as repair i finds it
    std::vector<Values<Scalar>> held;         // [i]: the part of its way that a particle goes in repair i
    bool shut = true;                         // whether every particle has a share of the coarse pressure
    bool cold = true;                         // whether no particle begins with a pressure
    double error = 0;                         // average compression as the last repair found it

    State<Scalar, D> result() const { return {x_now.back(), u.back(), k.back(), kick}; }

    // Whether there is a correction before iteration i: not before the first where a particle begins with a pressure.
    bool corrects(std::size_t i) const { return !corrections.empty() && (i > 0 || cold); }
    // y as iteration i - 1 leaves it, before it is corrected.
    const Values<Scalar>& uncorrected(std::size_t i) const { return i < corrections.size() ? corrections[i].y : y[i]; }

    // omega / a
    Scalar step_of(const Model<Scalar, D>& model, std::size_t i) const { return model.relaxation / effects[i].a; }
    // The same of a repair.
    Scalar repair_step_of(const Model<Scalar, D>& model, std::size_t repair, std::size_t i) const {
        return model.repair_relaxations[repair] / effects[i].a;
    }
    // How much a particle is pulled after all iterations, by which it is shifted.
    Scalar pulled(std::size_t i) const { return effects[i].repaired * k.back()[i]; }
    // f, by which the pressure of the step before is taken on; 0 where its kick would throw a particle at a wall.
    Scalar taken(const Model<Scalar, D>& model, const State<Scalar, D>& state, std::size_t i) const {
        const Vector<Scalar, D> way = model.time_step * state.kick[i];
        const Scalar towards = model.spacing / Scalar(10);
        const bool thrown = way.dot(moments[i].gamma) > Scalar(0) && way.dot(way) > towards * towards;
        return thrown ? Scalar(0) : effects[i].full;
    }
    // Of a change of the way that a particle would go in a repair, that of the way that it goes, and its transpose.
    Vector<Scalar, D> along(std::size_t repair, std::size_t i, const Vector<Scalar, D>& change) const {
        const Scalar part = held[repair][i];
        if (!(part < Scalar(1))) return change;
        const Vector<Scalar, D> way = x_now[repair + 1][i] - x_moved[i];
        return part * (change - (way.dot(change) / way.dot(way)) * way);
    }
    // The velocities of the last iteration, by whose A particles are shifted.
    const Vectors<Scalar, D>& flow() const { return u[u.size() - 2]; }
    // b, for a density n
    Scalar wanted(const Model<Scalar, D>& model, std::size_t i, const Scalar& n) const {
        const Scalar one(1);
        return n < one ? (one - effects[i].full) * (one - n) / model.time_step : Scalar(0);
    }

    // From lists over a state, its densities `without` images and predicted velocities.
    void take(const Model<Scalar, D>& model, const Pairs<Scalar, D>& fluid, const Pairs<Scalar, D>& walls,
              const State<Scalar, D>& state, const Values<Scalar>& without, const Vectors<Scalar, D>& v_star) {
        const std::size_t count = state.x.size(), iterations = model.maximum_iterations;
        const std::size_t repairs = model.repair_relaxations.size();
        const auto sized = [count](auto& all, std::size_t length) {
            all.resize(length);
            for (auto& one : all) one.resize(count);
        };
        for (auto* each : {&k, &y}) sized(*each, iterations + 1);
        sized(divergences, iterations);
        sized(u, iterations + 1);
        sized(x_now, repairs + 1);
        sized(c, repairs + 1);
        sized(excess, repairs);
        sized(held, repairs);
        find(model, fluid, walls, state.x, without);
        kick.resize(count);
        for (std::size_t i = 0; i < count; ++i) {
            const Scalar full = taken(model, state, i);
            k[0][i] = y[0][i] = full * state.k[i];
            u[0][i] = v_star[i] + full * state.kick[i];
        }
        cold = std::none_of(k[0].begin(), k[0].end(), [](const Scalar& one) { return one > Scalar(0); });
        corrections.resize(model.nodes.count() > 0 ? iterations : 0);
        if (!corrections.empty()) spread(model, fluid, state.x);
        for (std::size_t at = 0; at < iterations; ++at) {
            if (corrects(at)) correct(model, fluid, state.x, corrections[at], at);
            iterate(model, fluid, state.x, at);
            pull(model, fluid, state.x, y[at + 1], v_star, u[at + 1]);
        }
        move(model, fluid, state.x, u[iterations]);
        for (std::size_t at = 0; at < repairs; ++at) repair(model, fluid, walls, state.x, at);
    }

private:
    void find(const Model<Scalar, D>& model, const Pairs<Scalar, D>& fluid, const Pairs<Scalar, D>& walls,
              const Vectors<Scalar, D>& x, const Values<Scalar>& without) {
        const std::size_t count = x.size();
        n.resize(count);
        moments.resize(count);
        effects.resize(count);
        each_particle(count, model.threads, [&](std::size_t i) {
            Moments<Scalar, D> of;
            for (auto pair = fluid.begin_of(i); pair != fluid.end_of(i); ++pair) {
                const Vector<Scalar, D> g = model.volume * pair->gradient();
                of.M -= g * pair->x.transpose();
                of.Q += g * g.transpose() / model.rest_density;
                of.g += g;
            }
            for (auto pair = walls.begin_of(i); pair != walls.end_of(i); ++pair) {
                const Vector<Scalar, D> normal = model.wall_normals[pair->other].template cast<Scalar>();
                const Scalar volume = model.volume * model.wall_weights[pair->other];
                const Vector<Scalar, D> along = (volume * normal.dot(pair->gradient())) * normal;
                of.normal += along;
                of.whole += volume * pair->gradient();
                of.nu += volume * pair->w;
                if (!model.wall_mirrors[pair->other]) continue;
                of.mirror += along;
                of.behind += volume * pair->w;
            }
            each_image(model, fluid, x, i, [&](const Image<Scalar, D>& image) { of.images += model.volume * image.w; });
            of.gamma = Edge<Scalar, D>(model, of).gamma();
            moments[i] = of;
            effects[i] = Surroundings<Scalar, D>(model, of).found;
            n[i] = without[i] + effects[i].image * (of.images - of.behind);
        });
        shut = std::all_of(effects.begin(), effects.end(),
                           [](const Effects<Scalar, D>& of) { return real_part(of.shared) > Real(0); });
        if (!shut) return;
        for (Effects<Scalar, D>& of : effects) of.tension = Scalar(Real(1));  // also beside walls
    }

    // What pressures y of walls and images add to D^T y.
    Vector<Scalar, D> walled(const Model<Scalar, D>& model, const Pairs<Scalar, D>& fluid, const Vectors<Scalar, D>& x,
                             const Values<Scalar>& y, std::size_t i) const {
        Vector<Scalar, D> total = Vector<Scalar, D>::Constant(Scalar(0));
        each_image(model, fluid, x, i, [&](const Image<Scalar, D>& image) {
            const int j = image.other;
            total += (effects[i].image * y[i] + effects[j].image * y[j]) * image.gradient();
        });
        return y[i] * effects[i].push + model.volume * total;
    }

    // D^T y, but for that.
    Vector<Scalar, D> push(const Model<Scalar, D>& model, const Pairs<Scalar, D>& fluid, const Values<Scalar>& y,
                           std::size_t i) const {
        Vector<Scalar, D> total = Vector<Scalar, D>::Constant(Scalar(0));
        const Matrix<Scalar, D> T = y[i] * effects[i].L;
        for (auto pair = fluid.begin_of(i); pair != fluid.end_of(i); ++pair) {
            const int j = pair->other;
            total += model.volume * ((T + y[j] * effects[j].L) * pair->gradient());
        }
        return total;
    }

    // The velocity v* - D^T y / m that pressures leave.
    void pull(const Model<Scalar, D>& model, const Pairs<Scalar, D>& fluid, const Vectors<Scalar, D>& x,
              const Values<Scalar>& y, const Vectors<Scalar, D>& v_star, Vectors<Scalar, D>& left) {
        each_particle(y.size(), model.threads, [&](std::size_t i) {
            kick[i] = -(push(model, fluid, y, i) + walled(model, fluid, x, y, i)) / model.rest_density;
            left[i] = v_star[i] + kick[i];
        });
    }

    // D v
    Scalar divergence_of(const Model<Scalar, D>& model, const Pairs<Scalar, D>& fluid, const Vectors<Scalar, D>& x,
                         const Vectors<Scalar, D>& v, std::size_t i) const {
        Scalar divergence = effects[i].push.dot(v[i]) + effects[i].image * widening(model, fluid, x, v, i);
        for (auto pair = fluid.begin_of(i); pair != fluid.end_of(i); ++pair) {
            const Vector<Scalar, D> v_ij = v[i] - v[pair->other], corrected = effects[i].L * pair->gradient();
            divergence += model.volume * v_ij.dot(corrected);
        }
        return divergence;
    }

    // The coarse grid of positions.
    void spread(const Model<Scalar, D>& model, const Pairs<Scalar, D>& fluid, const Vectors<Scalar, D>& x) {
        Values<Scalar> c(x.size());
        for (std::size_t i = 0; i < x.size(); ++i) c[i] = effects[i].shared;
        coarse.pushes = Pushes<Scalar, D>(x.size());
        each_particle(x.size(), model.threads, [&](std::size_t i) {
            coarse.pushes.h[i] = push(model, fluid, c, i) + walled(model, fluid, x, c, i);
            for (auto pair = fluid.begin_of(i); pair != fluid.end_of(i); ++pair) {
                const Matrix<Scalar, D> T = c[pair->other] * effects[pair->other].L;
                coarse.pushes.N[i] -= T * (model.volume * pair->gradient()) * pair->x.transpose();
            }
            each_image(model, fluid, x, i, [&](const Image<Scalar, D>& image) {
                const Scalar pushed = model.volume * effects[image.other].image * c[image.other];
                coarse.pushes.N[i] -= pushed * image.gradient() * image.direct.transpose();
            });
        });
        coarse.find(model, x);
    }

    // The coarse correction of k, y and u, which `before` keeps.
    void correct(const Model<Scalar, D>& model, const Pairs<Scalar, D>& fluid, const Vectors<Scalar, D>& x,
                 Correction<Scalar, D>& before, std::size_t at) {
        before.y = y[at];
        before.u = u[at];
        for (auto* each : {&before.counted, &before.r, &before.d}) each->resize(n.size());
        before.f.resize(n.size());
        each_particle(n.size(), model.threads, [&](std::size_t i) {
            const Scalar left = divergence_of(model, fluid, x, before.u, i) - wanted(model, i, n[i]);
            const bool inside = before.y[i] > Scalar(0) || real_part(effects[i].tension) >= Real(1);
            const Scalar calm = Scalar(1'000'000) * model.time_step * left;
            const Smoothstep<Scalar> share(calm, -100, 100);
            before.r[i] = inside ? left : share.value * left;  // NaN must stay
            before.counted[i] = inside ? Scalar(1) : share.value + calm * share.slope;
        });
        before.e = coarse.solve(
            [&](std::size_t i, const Hat<Scalar, D>& hat) { return hat.value * effects[i].shared * before.r[i]; });
        each_particle(n.size(), model.threads, [&](std::size_t i) {
            const Scalar z = before.y[i] + effects[i].shared * coarse.at(i, before.e).value;
            const Scalar least = before.y[i] < Scalar(0) ? before.y[i] : Scalar(0), below = z - least;
            const Clamp<Scalar> clamp(below, below);
            before.d[i] = least + (clamp.rise + clamp.fall * effects[i].tension) * below - before.y[i];
        });
        each_particle(n.size(), model.threads, [&](std::size_t i) {
            before.f[i] =
                -(push(model, fluid, before.d, i) + walled(model, fluid, x, before.d, i)) / model.rest_density;
        });
        before.stride(model.rest_density, model.spacing / (Scalar(1'000'000) * model.time_step), at == 0);
        for (std::size_t i = 0; i < n.size(); ++i) {
            k[at][i] = y[at][i] = before.y[i] + before.alpha * before.d[i];
            u[at][i] = before.u[i] + before.alpha * before.f[i];
        }
    }

    void iterate(const Model<Scalar, D>& model, const Pairs<Scalar, D>& fluid, const Vectors<Scalar, D>& x,
                 std::size_t at) {
        each_particle(n.size(), model.threads, [&](std::size_t i) {
            const Scalar divergence = divergence_of(model, fluid, x, u[at], i);
            const Scalar per = step_of(model, i), down = y[at][i] + per * divergence;
            const Scalar up = y[at][i] + per * (divergence - wanted(model, i, n[i]));
            const Clamp<Scalar> clamp(up, down);
            const Scalar found = clamp.rise * up + clamp.fall * effects[i].tension * down;
            divergences[at][i] = divergence;
            k[at + 1][i] = found;
            y[at + 1][i] = found + model.momenta[at] * (found - k[at][i]);
        });
    }

    // The shift, and the positions that it and velocities lead to.
    void move(const Model<Scalar, D>& model, const Pairs<Scalar, D>& fluid, const Vectors<Scalar, D>& x,
              const Vectors<Scalar, D>& v) {
        for (Vectors<Scalar, D>* each : {&crowd, &apart, &x_moved}) each->resize(x.size());
        A.resize(x.size());
        each_particle(x.size(), model.threads, [&](std::size_t i) {
            const Vectors<Scalar, D>& w = flow();
            A[i] = Matrix<Scalar, D>::Constant(Scalar(0));
            crowd[i] = apart[i] = Vector<Scalar, D>::Constant(Scalar(0));
            for (auto pair = fluid.begin_of(i); pair != fluid.end_of(i); ++pair) {
                const Vector<Scalar, D> g = model.volume * pair->gradient();
                A[i] += (w[i] - w[pair->other]) * g.transpose();
                crowd[i] += Closeness<Scalar>(model.volume * pair->w, model.nearest_weight).value * g;
                apart[i] += Apart<Scalar, D>(model, pair->x).value();
            }
            const Shift<Scalar, D> shift(model, moments[i], effects[i].shifted, A[i], crowd[i], pulled(i), apart[i]);
            x_moved[i] = x[i] + model.time_step * v[i] + shift.delta;
            x_now[0][i] = x_moved[i];
            c[0][i] = Scalar(0);
        });
    }

    void repair(const Model<Scalar, D>& model, const Pairs<Scalar, D>& fluid, const Pairs<Scalar, D>& walls,
                const Vectors<Scalar, D>& x, std::size_t at) {
        const std::size_t count = x_moved.size();
        each_particle(count, model.threads, [&](std::size_t i) {
            const Scalar weights = model.self_weight + model.weights(i, fluid, walls, x_now[at]);
            excess[at][i] = model.volume * weights - Scalar(1);
            excess[at][i] += effects[i].image * surplus(model, fluid, walls, x_now[at], i);
            const Scalar z = c[at][i] + repair_step_of(model, at, i) * excess[at][i];
            c[at + 1][i] = z < Scalar(0) ? Scalar(effects[i].repaired * z) : z;
        });
        Real sum(0);
        for (const Scalar& one : excess[at])
            if (real_part(one) > Real(0)) sum += real_part(one);
        error = double(sum / Real(double(count)));
        each_particle(count, model.threads, [&](std::size_t i) {
            Vector<Scalar, D> total = walled(model, fluid, x, c[at + 1], i);
            for (auto pair = fluid.begin_of(i); pair != fluid.end_of(i); ++pair)
                total += (model.volume * (c[at + 1][i] + c[at + 1][pair->other])) * pair->gradient();
            const Vector<Scalar, D> back = total / model.rest_density;
            const Scalar farthest = model.spacing / Scalar(6), square = back.dot(back);
            held[at][i] = square > farthest * farthest ? Scalar(farthest / square_root(square)) : Scalar(1);
            x_now[at + 1][i] = x_moved[i] - held[at][i] * back;
        });
    }
};

}  // namespace cortado
