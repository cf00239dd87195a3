// Derivatives of viscosity as a stress: the tangent of its force, and the transpose of that.
#pragma once

#include "step.hpp"

namespace cortado {

// The gradient of an arm's weight, and from a change of a separation to that of y, which is symmetric.
template <class Real, int D>
struct ArmSlope {
    Vector<Real, D> s;
    Matrix<Real, D> y;
};

template <class Real, int D>
ArmSlope<Real, D> arm_slope(const Model<Real, D>& model, const Pair<Real, D>& pair, bool wall) {
    if (!wall) return {(-model.volume * pair.b) * pair.x, Matrix<Real, D>::Identity()};
    const Vector<Real, D>& normal = model.wall_normals[pair.other];
    const Real across = normal.dot(pair.x), height = across - model.wall_depths[pair.other];
    const bool free = height > model.closest;
    const Real held = free ? height : model.closest, weight = -model.wall_weights[pair.other] * model.volume;
    const Real by_height = (1 - (free ? Real(across / held) : Real(0))) / held;
    const Matrix<Real, D> along = normal * normal.transpose();
    return {(weight * across / held * pair.b) * pair.x + (weight * pair.a * by_height) * normal,
            (height > Real(0) ? Real(1) : Real(0)) * along};
}

// The derivative of T and S of one particle, at M and A.
template <class Real, int D>
class LocalStress {
public:
    LocalStress(const Model<Real, D>& model, const Matrix<Real, D>& M, const Matrix<Real, D>& A)
        : C_(model.control), A_(A), full_(M) {
        if (full_.S == Real(0)) return;
        K_ = M.inverse();
        G_ = A * K_;
        twice_D_ = G_ + G_.transpose();
        P_ = twice_D_ * K_ - C_ * G_;
    }

    // From changes of M and A to those of T and S.
    std::pair<Matrix<Real, D>, Real> tangent(const Matrix<Real, D>& dM, const Matrix<Real, D>& dA) const {
        if (full_.S == Real(0)) return {Matrix<Real, D>::Zero(), Real(0)};
        const Matrix<Real, D> dK = -K_ * dM * K_, dG = dA * K_ + A_ * dK;
        const Matrix<Real, D> dP = (dG + dG.transpose()) * K_ + twice_D_ * dK - C_ * dG;
        const Real dS = full_.slope.cwiseProduct(dM).sum();
        return {full_.S * dP + dS * P_, dS};
    }

    // The transpose; the adjoint of M is symmetric.
    std::pair<Matrix<Real, D>, Matrix<Real, D>> adjoint(const Matrix<Real, D>& T_bar, Real S_bar) const {
        if (full_.S == Real(0)) return {Matrix<Real, D>::Zero(), Matrix<Real, D>::Zero()};
        const Matrix<Real, D> P_bar = full_.S * T_bar, turned = P_bar * K_;
        const Matrix<Real, D> G_bar = turned + turned.transpose() - C_ * P_bar;
        const Matrix<Real, D> K_bar = twice_D_ * P_bar + A_.transpose() * G_bar, M_bar = -K_ * K_bar * K_;
        const Real total = S_bar + T_bar.cwiseProduct(P_).sum();
        return {(M_bar + M_bar.transpose()) / 2 + total * full_.slope, G_bar * K_};
    }

private:
    Real C_;
    Matrix<Real, D> A_;
    Fullness<Real, D> full_;
    Matrix<Real, D> K_, G_, twice_D_, P_;
};

// Of the forces over the viscosity.
template <class Real, int D>
Vectors<Real, D> stress_tangent(const Model<Real, D>& model, const Step<Real, D>& step, const State<Real, D>& state,
                                const State<Real, D>& dot) {
    const std::size_t count = state.x.size();
    const Stress<Real, D>& stress = step.stress;
    Matrices<Real, D> dT(count);
    Values<Real> dS(count);
    // `body(arm, ds, dy, j)`
    const auto each = [&](std::size_t i, const auto& body) {
        each_arm(model, i, step.fluid, step.walls, [&](const Pair<Real, D>& pair, const Arm<Real, D>& arm, int j) {
            const Vector<Real, D> dx = difference_of(dot.x, i, j);
            const ArmSlope<Real, D> slope = arm_slope(model, pair, j < 0);
            body(arm, Real(slope.s.dot(dx)), Vector<Real, D>(slope.y * dx), j);
        });
    };
    each_particle(count, model.threads, [&](std::size_t i) {
        Matrix<Real, D> dM = Matrix<Real, D>::Zero(), dA = dM;
        each(i, [&](const Arm<Real, D>& arm, const Real& ds, const Vector<Real, D>& dy, int j) {
            const Vector<Real, D> v = difference_of(state.v, i, j), dv = difference_of(dot.v, i, j);
            const Vector<Real, D> change = ds * arm.y + arm.s * dy;
            dM += change * arm.y.transpose() + arm.s * arm.y * dy.transpose();
            dA += v * change.transpose() + arm.s * dv * arm.y.transpose();
        });
        std::tie(dT[i], dS[i]) = LocalStress<Real, D>(model, stress.M[i], stress.A[i]).tangent(dM, dA);
    });
    Vectors<Real, D> change = zero_vectors<Real, D>(count);
    each_particle(count, model.threads, [&](std::size_t i) {
        each(i, [&](const Arm<Real, D>& arm, const Real& ds, const Vector<Real, D>& dy, int j) {
            const Vector<Real, D> v = difference_of(state.v, i, j), dv = difference_of(dot.v, i, j);
            change[i] -= ds * stress.pull(model, i, j, arm, state.v);
            change[i] -= arm.s * (sum_of(dT, i, j) * arm.y + sum_of(stress.T, i, j) * dy);
            change[i] -= (arm.s * model.control) * (sum_of(dS, i, j) * v + sum_of(stress.S, i, j) * dv);
        });
    });
    return change;
}

// Adds to the adjoint of a state, given that of the forces over the viscosity.
template <class Real, int D>
void stress_adjoint(const Model<Real, D>& model, const Step<Real, D>& step, const State<Real, D>& state,
                    const Vectors<Real, D>& force_bar, State<Real, D>& bar) {
    const std::size_t count = state.x.size();
    const Stress<Real, D>& stress = step.stress;
    Matrices<Real, D> M_bar(count), A_bar(count);
    each_particle(count, model.threads, [&](std::size_t i) {
        Matrix<Real, D> T_bar = Matrix<Real, D>::Zero();
        Real S_bar = 0;
        each_arm(model, i, step.fluid, step.walls, [&](const auto&, const Arm<Real, D>& arm, int j) {
            const Vector<Real, D> u = -arm.s * difference_of(force_bar, i, j);
            T_bar += u * arm.y.transpose();
            S_bar += model.control * u.dot(difference_of(state.v, i, j));
        });
        std::tie(M_bar[i], A_bar[i]) = LocalStress<Real, D>(model, stress.M[i], stress.A[i]).adjoint(T_bar, S_bar);
    });
    each_particle(count, model.threads, [&](std::size_t i) {
        each_arm(model, i, step.fluid, step.walls, [&](const Pair<Real, D>& pair, const Arm<Real, D>& arm, int j) {
            const Vector<Real, D> u = difference_of(force_bar, i, j), v = difference_of(state.v, i, j);
            const Matrix<Real, D> of_A = sum_of(A_bar, i, j);
            const Vector<Real, D> turned = sum_of(M_bar, i, j) * arm.y, pulled = of_A * arm.y;
            const Real s_bar = arm.y.dot(turned) + v.dot(pulled) - u.dot(stress.pull(model, i, j, arm, state.v));
            const Vector<Real, D> y_bar =
                arm.s * (2 * turned + of_A.transpose() * v - sum_of(stress.T, i, j).transpose() * u);
            const ArmSlope<Real, D> slope = arm_slope(model, pair, j < 0);
            bar.x[i] += s_bar * slope.s + slope.y * y_bar;
            bar.v[i] += arm.s * (pulled - (model.control * sum_of(stress.S, i, j)) * u);
        });
    });
}

}  // namespace cortado
