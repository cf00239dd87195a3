// One step of PCISPH (Solenthaler and Pajarola 2009; the report's Algorithm 1, put right), or of the projection, with
// every intermediate value that its derivatives need. Memory is kept from one step to the next. docs/discretisation.md
// writes the same step in the same order.
#pragma once

#include "projection.hpp"

namespace cortado {

template <class Scalar, int D>
struct Step {
    using Real = typename RealOf<Scalar>::type;

    Pairs<Scalar, D> fluid, walls;
    Values<Scalar> n;                  // number density
    Values<Scalar> y;                  // yield beside walls
    Vectors<Scalar, D> wall_gradient;  // sum_b w_b G_ib
    Vectors<Scalar, D> friction_sum;   // sum_j (V / n_j) phi_ij + friction sum_b V w_b phi_ib, or the stress's force
    Stress<Scalar, D> stress;
    Vectors<Scalar, D> acceleration;   // without pressure
    std::vector<Vectors<Scalar, D>> x_star;  // [k]: at which iteration k finds the density; the last is the result
    std::vector<Values<Scalar>> excess;      // [k]: m n* - rho_0
    std::vector<Values<Scalar>> p;           // [k]: after iteration k
    Vectors<Scalar, D> v_star;               // the last: the result
    Projection<Scalar, D> projection;        // what it makes of the first x_star and v_star
    double error = 0, greatest_error = 0;    // compression as the last iteration found it

    int iterations() const { return iterations_; }
    State<Scalar, D> result() const {
        return projected_ ? projection.result() : State<Scalar, D>{x_star[iterations_], v_star, {}, {}};
    }
    Scalar delta(const Model<Scalar, D>& model, std::size_t i) const {
        return y[i] * model.stiffness / (model.time_step * model.time_step);
    }

    // Take a step; `iterations` -1: as many of PCISPH as the tolerances ask for.
    void take(const Model<Scalar, D>& model, const State<Scalar, D>& state, const Vector<Scalar, D>& gravity,
              const Scalar& viscosity, int iterations = -1) {
        const std::size_t count = state.x.size();
        const Scalar m = model.rest_density, dt = model.time_step;
        fluid.find(state.x, state.x, cells_of<Scalar, D>(state.x, model.reach, model.periods), true, model.reach,
                   model.period, model.smoothing, model.threads);
        walls.find(state.x, model.wall_positions, model.wall_cells, false, model.reach, model.period, model.smoothing,
                   model.threads);
        n.resize(count);
        y.resize(count);
        wall_gradient.resize(count);
        each_particle(count, model.threads, [&](std::size_t i) {
            Scalar total = model.self_weight;
            for (auto pair = fluid.begin_of(i); pair != fluid.end_of(i); ++pair) total += pair->w;
            Vector<Scalar, D> gradient = Vector<Scalar, D>::Constant(Scalar(0));
            for (auto pair = walls.begin_of(i); pair != walls.end_of(i); ++pair) {
                total += model.wall_weights[pair->other] * pair->w;
                gradient += model.wall_weights[pair->other] * pair->gradient();
            }
            n[i] = model.volume * total;
            wall_gradient[i] = gradient;
            y[i] = Scalar(1) / (Scalar(1) + gradient.dot(gradient) / model.response);
        });
        friction_sum.assign(count, Vector<Scalar, D>::Constant(Scalar(0)));
        acceleration.assign(count, gravity);
        if (model.viscosity == Viscosity::stress) {
            stress.find(model, fluid, walls, state.v);
            each_particle(count, model.threads, [&](std::size_t i) {
                friction_sum[i] = stress.force(model, i, fluid, walls, state.v);
                acceleration[i] += viscosity / m * friction_sum[i];
            });
        } else if (model.viscosity != Viscosity::none) {
            each_particle(count, model.threads, [&](std::size_t i) {
                Vector<Scalar, D> total = friction_sum[i];
                for (auto pair = fluid.begin_of(i); pair != fluid.end_of(i); ++pair) {
                    const Vector<Scalar, D> v_ij = state.v[i] - state.v[pair->other];
                    total += model.volume / n[pair->other] * model.phi(*pair, v_ij);
                }
                if (real_part(model.friction) != Real(0))
                    for (auto pair = walls.begin_of(i); pair != walls.end_of(i); ++pair)
                        total += model.friction * model.volume * model.wall_weights[pair->other] *
                                 model.phi(*pair, state.v[i]);
                friction_sum[i] = total;
                acceleration[i] += model.kappa * viscosity / (m * n[i]) * total;
            });
        }
        v_star.resize(count);
        iterations_ = 0;
        sized(x_star, 0, count);
        each_particle(count, model.threads, [&](std::size_t i) {
            v_star[i] = state.v[i] + dt * acceleration[i];
            x_star[0][i] = state.x[i] + dt * v_star[i];
        });
        projected_ = model.projection;
        if (projected_) {
            projection.take(model, fluid, walls, state, n, v_star);
            iterations_ = model.maximum_iterations;
            error = projection.error;
            return;
        }
        const bool free = iterations < 0;
        const int least = !model.pressure ? 0 : free ? model.minimum_iterations : iterations;
        const int most = !model.pressure ? 0 : free ? model.maximum_iterations : iterations;
        while (iterations_ < least || (iterations_ < most && !converged(model))) iterate(model, state);
    }

private:
    template <class Values>
    static void sized(std::vector<Values>& all, int k, std::size_t count) {
        if (int(all.size()) <= k) all.resize(k + 1);
        all[k].resize(count);
    }

    bool converged(const Model<Scalar, D>& model) const {
        return Real(error) <= model.density_tolerance && Real(greatest_error) <= model.maximum_density_tolerance;
    }

    void iterate(const Model<Scalar, D>& model, const State<Scalar, D>& state) {
        const std::size_t count = state.x.size();
        const int k = iterations_++;
        const Scalar m = model.rest_density, dt = model.time_step, zero(0);
        sized(excess, k, count);
        sized(p, k, count);
        sized(x_star, k + 1, count);
        c_.resize(count);
        each_particle(count, model.threads, [&](std::size_t i) {
            excess[k][i] =
                m * model.volume * (model.self_weight + model.weights(i, fluid, walls, x_star[k])) - model.rest_density;
            const Scalar before = k > 0 ? p[k - 1][i] : zero;
            const Scalar pressure = before + delta(model, i) * excess[k][i];
            p[k][i] = pressure < zero ? zero : pressure;  // not a maximum: NaN must stay
            c_[i] = p[k][i] / (n[i] * n[i]);
        });
        Real sum(0), greatest(0);
        for (const Scalar& one : excess[k]) {
            const Real compression = real_part(one) > Real(0) ? Real(real_part(one) / real_part(m)) : Real(0);
            sum += compression;
            greatest = std::max(greatest, compression);
        }
        error = double(sum / Real(double(count)));
        greatest_error = double(greatest);
        each_particle(count, model.threads, [&](std::size_t i) {
            Vector<Scalar, D> total = Vector<Scalar, D>::Constant(zero);
            for (auto pair = fluid.begin_of(i); pair != fluid.end_of(i); ++pair)
                total += ((c_[i] + c_[pair->other]) * pair->a) * pair->x;
            for (auto pair = walls.begin_of(i); pair != walls.end_of(i); ++pair)
                total += (model.wall_weights[pair->other] * c_[i] * pair->a) * pair->x;
            v_star[i] = state.v[i] + dt * (acceleration[i] - model.volume / m * total);
            x_star[k + 1][i] = state.x[i] + dt * v_star[i];
        });
    }

    bool projected_ = false;
    int iterations_ = 0;
    Values<Scalar> c_;
};

}  // namespace cortado
