// The time loop: forward, with a tangent by any method, and back with the adjoint.
#pragma once

#include <cmath>
#include <stdexcept>

#include "adjoint.hpp"
#include "printed.hpp"
#include "tangent.hpp"

namespace cortado {

template <class Real, int D>
class Rollout final : public Engine {
public:
    Rollout(const Scene& scene, int threads) : scene_(scene), threads_(threads), model_(scene, threads) {}

    History run(const Parameters& at, int steps, int record_every, const Observer& observe) const override {
        const Run<Real> run = begin(at, steps);
        History history;
        forward<Real>(model_, run, history, observe, [&](int step, const State<Real, D>& state) {
            record(history, step, steps, record_every, state);
        });
        return history;
    }

    History tangent(const Parameters& at, const Parameters& along, int steps, int record_every,
                    const std::string& method, const Terms& terms, double difference,
                    const Observer& observe) const override {
        const Run<Real> run = begin(at, steps), dot = begin(along, steps);
        History history;
        const auto keep = [&](int step, const State<Real, D>& state, const State<Real, D>& state_dot) {
            record(history, step, steps, record_every, state, &state_dot);
            history.position_norms.push_back(norm(state_dot.x));
            history.velocity_norms.push_back(norm(state_dot.v));
        };
        if (method == "dual") {
            extended<Dual<Real>>(run, dot, Real(1), history, observe, keep);
        } else if (method == "complex_step") {
            // So small that its square is below round-off beside 1: nothing is cancelled.
            extended<Complex<Real>>(run, dot, epsilon<Real>() * epsilon<Real>(), history, observe, keep);
        } else if (method == "finite_difference") {
            differences(run, dot, Real(difference), history, observe, keep);
        } else {
            State<Real, D> state_dot = dot.first;
            keep(0, run.first, state_dot);
            State<Real, D> before = run.first;
            forward<Real>(model_, run, history, observe, [](int, const State<Real, D>&) {},
                          [&](int n, Step<Real, D>& step) {
                              state_dot = one_step(method, step, before, state_dot, run, dot, n, terms);
                              before = step.result();
                              keep(n + 1, before, state_dot);
                          });
        }
        return history;
    }

    Gradient gradient(const Parameters& at, int steps, int record_every, const Terms& terms, const LossAdjoint& loss,
                      const Observer& observe) const override {
        const Run<Real> run = begin(at, steps);
        Gradient found;
        History& history = found.history;
        std::vector<State<Real, D>> states;
        forward<Real>(model_, run, history, observe, [&](int step, const State<Real, D>& state) {
            record(history, step, steps, record_every, state);
            states.push_back(state);
        });
        if (history.bad_step >= 0) return found;
        Numbers x, v;
        append(x, states.back().x);
        append(v, states.back().v);
        const auto [x_bar, v_bar] = loss(x, v);
        State<Real, D> bar{joined_vectors<Real, D>(x_bar), joined_vectors<Real, D>(v_bar),
                           Values<Real>(states.back().k.size(), Real(0)),
                           zero_vectors<Real, D>(states.back().kick.size())};
        Vectors<Real, D> gravity_bar = zero_vectors<Real, D>(steps);
        Real viscosity_bar = 0;
        history.position_norms.assign(steps + 1, norm(bar.x));
        history.velocity_norms.assign(steps + 1, norm(bar.v));
        Step<Real, D> step;
        for (int n = steps - 1; n >= 0; --n) {
            if (observe) observe(n);
            step.take(model_, states[n], run.gravity[n], run.viscosity, history.iterations[n]);
            step_adjoint(model_, step, states[n], bar, run.viscosity, terms, gravity_bar[n], viscosity_bar);
            history.position_norms[n] = norm(bar.x);
            history.velocity_norms[n] = norm(bar.v);
        }
        append(found.bar.positions, bar.x);
        append(found.bar.velocities, bar.v);
        append(found.bar.gravity, gravity_bar);
        append(found.bar.viscosity, viscosity_bar);
        return found;
    }

private:
    // The first state and the parameters of a run, and also a direction of them.
    template <class Scalar>
    struct Run {
        State<Scalar, D> first;
        Vectors<Scalar, D> gravity;  // (steps,)
        Scalar viscosity;
    };

    static Run<Real> begin(const Parameters& at, int steps) {
        Run<Real> run{{joined_vectors<Real, D>(at.positions), joined_vectors<Real, D>(at.velocities),
                       Values<Real>(at.positions.size() / D, Real(0)),
                       zero_vectors<Real, D>(at.positions.size() / D)},
                      joined_vectors<Real, D>(at.gravity),
                      joined<Real>(at.viscosity, 0)};
        if (int(run.gravity.size()) != steps) throw std::invalid_argument("gravity must have a vector for each step");
        return run;
    }

    template <class Scalar, class Visit>
    static void forward(const Model<Scalar, D>& model, const Run<Scalar>& run, History& history,
                        const Observer& observe, const Visit& visit) {
        forward(model, run, history, observe, visit, [](int, Step<Scalar, D>&) {});
    }

    // `visit` is given every state, `during` every step after it was made. Ends early where a particle is lost.
    template <class Scalar, class Visit, class During>
    static void forward(const Model<Scalar, D>& model, const Run<Scalar>& run, History& history,
                        const Observer& observe, const Visit& visit, const During& during) {
        State<Scalar, D> state = run.first;
        Step<Scalar, D> step;
        visit(0, state);
        for (int n = 0; n < int(run.gravity.size()); ++n) {
            if (observe) observe(n);
            step.take(model, state, run.gravity[n], run.viscosity);
            if (lost(model, step.result(), n, history)) return;
            history.iterations.push_back(step.iterations());
            history.errors.push_back(step.error);
            during(n, step);
            state = step.result();
            visit(n + 1, state);
        }
        if (observe) observe(int(run.gravity.size()));
    }

    template <class Scalar>
    static bool lost(const Model<Scalar, D>& model, const State<Scalar, D>& state, int step, History& history) {
        const double far = 1e6 * model.reach;
        for (std::size_t i = 0; i < state.x.size(); ++i)
            for (int axis = 0; axis < D; ++axis) {
                const double x = double(real_part(state.x[i][axis])), v = double(real_part(state.v[i][axis]));
                if (std::abs(x) < far && std::isfinite(v)) continue;
                history.bad_step = step;
                history.bad_particle = int(i);
                return true;
            }
        return false;
    }

    static void record(History& history, int step, int steps, int every, const State<Real, D>& state,
                       const State<Real, D>* dot = nullptr) {
        if (step % every != 0 && step != steps) return;
        history.frames.push_back(step);
        append(history.positions, state.x);
        append(history.velocities, state.v);
        if (!dot) return;
        append(history.position_dots, dot->x);
        append(history.velocity_dots, dot->v);
    }

    State<Real, D> one_step(const std::string& method, Step<Real, D>& step, const State<Real, D>& state,
                            const State<Real, D>& state_dot, const Run<Real>& run, const Run<Real>& dot, int n,
                            const Terms& terms) const {
        const auto printed = [&](const Reading& reading) {
            return printed_tangent(model_, step, state, state_dot, dot.gravity[n], run.viscosity, reading);
        };
        if (method == "as_printed") return printed({});
        if (method == "as_printed_right_viscosity") return printed({false, false});
        if (method == "as_printed_predicted_density") return printed({true, false});
        if (method != "analytic") throw std::invalid_argument("method " + method + " is unknown");
        return step_tangent(model_, step, state, state_dot, dot.gravity[n], run.viscosity, dot.viscosity, terms);
    }

    // The whole run on numbers a + b u, with `size` times the direction in b.
    template <class Scalar, class Keep>
    void extended(const Run<Real>& run, const Run<Real>& dot, Real size, History& history, const Observer& observe,
                  const Keep& keep) const {
        const auto joined = [&](const Vectors<Real, D>& a, const Vectors<Real, D>& b) {
            Vectors<Scalar, D> both(a.size());
            for (std::size_t i = 0; i < a.size(); ++i)
                for (int axis = 0; axis < D; ++axis) both[i][axis] = Scalar(a[i][axis], size * b[i][axis]);
            return both;
        };
        const Run<Scalar> both{{joined(run.first.x, dot.first.x), joined(run.first.v, dot.first.v),
                                Values<Scalar>(run.first.k.size(), Scalar(0)),
                                zero_vectors<Scalar, D>(run.first.kick.size())},
                               joined(run.gravity, dot.gravity),
                               Scalar(run.viscosity, size * dot.viscosity)};
        const auto part = [&](const Vectors<Scalar, D>& from, bool second) {
            Vectors<Real, D> to(from.size());
            for (std::size_t i = 0; i < from.size(); ++i)
                for (int axis = 0; axis < D; ++axis)
                    to[i][axis] = second ? Real(from[i][axis].b / size) : from[i][axis].a;
            return to;
        };
        forward<Scalar>(Model<Scalar, D>(scene_, threads_), both, history, observe,
                        [&](int step, const State<Scalar, D>& state) {
                            keep(step, State<Real, D>{part(state.x, false), part(state.v, false), {}, {}},
                                 State<Real, D>{part(state.x, true), part(state.v, true), {}, {}});
                        });
    }

    // (run at p + h d - run at p - h d) / (2 h), in this precision; the states are those of the run ahead.
    template <class Keep>
    void differences(const Run<Real>& run, const Run<Real>& dot, Real h, History& history, const Observer& observe,
                     const Keep& keep) const {
        const auto moved = [&](Real by) {
            Run<Real> other = run;
            const auto add = [&](Vectors<Real, D>& to, const Vectors<Real, D>& from) {
                for (std::size_t i = 0; i < to.size(); ++i) to[i] += by * from[i];
            };
            add(other.first.x, dot.first.x);
            add(other.first.v, dot.first.v);
            add(other.gravity, dot.gravity);
            other.viscosity += by * dot.viscosity;
            return other;
        };
        std::vector<State<Real, D>> behind;
        History unused;
        forward<Real>(model_, moved(-h), unused, Observer(),
                      [&](int, const State<Real, D>& state) { behind.push_back(state); });
        forward<Real>(model_, moved(h), history, observe, [&](int step, const State<Real, D>& state) {
            if (step >= int(behind.size())) return;
            State<Real, D> dot_of = state;
            for (std::size_t i = 0; i < state.x.size(); ++i) {
                dot_of.x[i] = (state.x[i] - behind[step].x[i]) / (2 * h);
                dot_of.v[i] = (state.v[i] - behind[step].v[i]) / (2 * h);
            }
            keep(step, state, dot_of);
        });
        if (unused.bad_step >= 0 && (history.bad_step < 0 || unused.bad_step < history.bad_step)) {
            history.bad_step = unused.bad_step;
            history.bad_particle = unused.bad_particle;
        }
    }

    Scene scene_;
    int threads_;
    Model<Real, D> model_;
};

template <class Real, int D>
std::unique_ptr<Engine> engine_of(const Scene& scene, int threads) {
    return std::make_unique<Rollout<Real, D>>(scene, threads);
}

}  // namespace cortado
