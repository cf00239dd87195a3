// Derivatives of what a particle's neighbourhood lets the projection do, and of its shift: tangents, and their
// transposes.
#pragma once

#include "surroundings.hpp"

namespace cortado {

template <class Real, int D>
Matrix<Real, D> even(const Matrix<Real, D>& A) {
    return (A + A.transpose()) / Real(2);
}

// From a change of M, and from an adjoint of J = 1.05 (M + 0.05)^-1: both are -J A J / 1.05.
template <class Real, int D>
Matrix<Real, D> inverse_change(const Matrix<Real, D>& J, const Matrix<Real, D>& A) {
    return -J * A * J / hundredths<Real>(105);
}

// The derivative of the effects of moments, at these moments.
template <class Real, int D>
class SurroundingsSlope {
public:
    SurroundingsSlope(const Model<Real, D>& model, const Moments<Real, D>& of)
        : m_(model.rest_density), of_(of), at_(model, of) {
        lack_slope_ = -hundredths<Real>(21) / (at_.below * at_.below * (D - 1));
        inner_ = at_.K - Matrix<Real, D>::Identity();
    }

    Effects<Real, D> tangent(const Moments<Real, D>& dot) const {
        const Real alone_dot = at_.alone.slope * (dot.nu - dot.behind);
        const Real behind_dot = alone_dot * of_.behind + at_.alone.value * dot.behind;
        const Real dH = at_.filling.slope.cwiseProduct(dot.M).sum(), dB = at_.away.slope * (dot.nu + 9 * behind_dot);
        const Real open_dot = at_.open.slope * (dot.nu - behind_dot);
        const Vector<Real, D>& leaning = at_.leaning;
        const Vector<Real, D> leaning_dot = dot.gamma - at_.alone.value * dot.mirror - alone_dot * of_.mirror;
        const Matrix<Real, D> grown = leaning * leaning_dot.transpose() + leaning_dot * leaning.transpose();
        const Matrix<Real, D> dN = (grown - 2 * leaning.dot(leaning_dot) * at_.N) / at_.direction;
        const Matrix<Real, D> across = at_.P * dot.M * at_.N + at_.P * of_.M * dN - dN * of_.M * at_.N;
        const Real lean_dot = dot.M.cwiseProduct(at_.N).sum() + of_.M.cwiseProduct(dN).sum();
        const Matrix<Real, D> dC = (hundredths<Real>(210) * even<Real, D>(across) - lean_dot * at_.C) / at_.lean;
        const Matrix<Real, D> dK =
            of_inverse(inverse_change<Real, D>(at_.J, dot.M)) + at_.repaired.slope * dH * at_.late;
        const Real lack_dot = lack_slope_ * (dot.M.cwiseProduct(at_.P).sum() - of_.M.cwiseProduct(dN).sum());
        const Matrix<Real, D> beside_dot = lack_dot * (at_.P - at_.C) - at_.lack * dN - (1 + at_.lack) * dC;
        const Matrix<Real, D> change = dB * inner_ - open_dot * at_.beside + at_.away.value * dK +
                                       (1 - at_.open.value) * beside_dot;
        Effects<Real, D> found;
        found.L = at_.corrected.slope * dH * at_.bare + at_.corrected.value * change;
        const Vector<Real, D> own_dot = found.L * of_.g + at_.found.L * dot.g + dot.gamma;
        const Matrix<Real, D> square = at_.found.L * at_.found.L, turned = of_.Q * at_.found.L;
        found.a = 2 * at_.own.dot(own_dot) / m_ + 2 * found.L.cwiseProduct(turned).sum() +
                  square.cwiseProduct(dot.Q).sum();
        found.tension = at_.tension.slope * dH * at_.away.value + at_.tension.value * dB;
        found.full = at_.full.slope * (dH + dot.nu);
        found.shifted = at_.shifted.slope * dH;
        found.repaired = at_.repaired.slope * dH * at_.away.value + at_.repaired.value * dB;
        found.shared = at_.shared.slope * (dH + 2 * dot.nu);
        const Real image_dot = at_.image.slope * (dot.images - of_.images / at_.behind * dot.behind) / at_.behind;
        found.image = image_dot * at_.alone.value + at_.image.value * alone_dot;
        found.push = dot.gamma - at_.found.image * dot.mirror - found.image * of_.mirror;
        return found;
    }

    // The transpose; the adjoints of M and Q are symmetric.
    Moments<Real, D> adjoint(const Effects<Real, D>& bar) const {
        const Matrix<Real, D>& L = at_.found.L;
        Moments<Real, D> found;
        const Vector<Real, D> own_bar = 2 * bar.a / m_ * at_.own;
        const Matrix<Real, D> by_a = own_bar * of_.g.transpose() + 2 * bar.a * of_.Q * L;
        const Matrix<Real, D> L_bar = even<Real, D>(bar.L + by_a), bare_bar = at_.corrected.value * L_bar;
        found.Q = bar.a * L * L;
        found.g = L * own_bar;
        const Matrix<Real, D> K_bar = at_.away.value * bare_bar;
        const Real H_bar = at_.corrected.slope * L_bar.cwiseProduct(at_.bare).sum() +
                           at_.tension.slope * at_.away.value * bar.tension + at_.full.slope * bar.full +
                           at_.shifted.slope * bar.shifted + at_.repaired.slope * at_.away.value * bar.repaired +
                           at_.repaired.slope * K_bar.cwiseProduct(at_.late).sum() + at_.shared.slope * bar.shared;
        const Real B_bar = bare_bar.cwiseProduct(inner_).sum() + at_.tension.value * bar.tension +
                           at_.repaired.value * bar.repaired;
        const Real by_away = at_.away.slope * B_bar;
        const Real by_open = -at_.open.slope * bare_bar.cwiseProduct(at_.beside).sum();
        const Real image_bar = bar.image - of_.mirror.dot(bar.push);
        found.images = at_.image.slope * at_.alone.value * image_bar / at_.behind;
        found.nu = by_away + by_open + at_.full.slope * bar.full + 2 * at_.shared.slope * bar.shared;
        const Matrix<Real, D> beside_bar = (1 - at_.open.value) * bare_bar, C_bar = -(1 + at_.lack) * beside_bar;
        const Matrix<Real, D> across_bar = hundredths<Real>(210) / at_.lean * C_bar;
        const Real lacked = lack_slope_ * beside_bar.cwiseProduct(at_.P - at_.C).sum();
        const Real lean_bar = -C_bar.cwiseProduct(at_.C).sum() / at_.lean;
        const Matrix<Real, D> N_bar = even<Real, D>(of_.M * at_.P * across_bar - across_bar * at_.N * of_.M) +
                                      (lean_bar - lacked) * of_.M - at_.lack * beside_bar;
        const Real along = N_bar.cwiseProduct(at_.N).sum();
        const Vector<Real, D> leaning_bar = 2 / at_.direction * (N_bar * at_.leaning - along * at_.leaning);
        found.gamma = own_bar + leaning_bar + bar.push;
        found.mirror = -at_.alone.value * leaning_bar - at_.found.image * bar.push;
        const Real behind_bar = 9 * by_away - by_open;
        const Real by_alone = at_.alone.slope * (behind_bar * of_.behind - leaning_bar.dot(of_.mirror) +
                                                 at_.image.value * image_bar);
        found.nu += by_alone;
        found.behind = at_.alone.value * behind_bar - of_.images / at_.behind * found.images - by_alone;
        found.M = H_bar * at_.filling.slope + inverse_change<Real, D>(at_.J, of_inverse(K_bar)) +
                  even<Real, D>(at_.P * across_bar * at_.N) + lean_bar * at_.N + lacked * at_.P;
        return found;
    }

private:
    // The change of K with J, which is symmetric.
    Matrix<Real, D> of_inverse(const Matrix<Real, D>& A) const {
        return A + newton<Real>() * at_.repaired.value * (A * at_.J + at_.J * A - A);
    }

    Real m_;
    Moments<Real, D> of_;
    Surroundings<Real, D> at_;
    Matrix<Real, D> inner_;  // K - 1
    Real lack_slope_;        // of t by M : P
};

// What the shift of a particle depends on but moments, and also a change of that and an adjoint.
template <class Real, int D>
struct Crowding {
    Matrix<Real, D> A;
    Vector<Real, D> crowd;
    Real shifted, pull;
    Vector<Real, D> apart;
};

template <class Real, int D>
class ShiftSlope {
public:
    ShiftSlope(const Model<Real, D>& model, const Moments<Real, D>& of, const Crowding<Real, D>& at)
        : A_(at.A),
          away_(4 * at.apart),
          shifted_(at.shifted),
          at_(model, of, at.shifted, at.A, at.crowd, at.pull, at.apart) {
        const Real dt = model.time_step;
        rate_slope_ = 20 * dt * dt / at_.root;
        pulled_slope_ = Pulled<Real, D>(model, at.pull).slope;
        scale_ = -model.spacing * model.spacing;
        strength_slope_ = 1 / (at_.bend * at_.bend * at_.bend);
    }

    Vector<Real, D> tangent(const Moments<Real, D>& dot, const Crowding<Real, D>& change) const {
        const Matrix<Real, D> dG = change.A * at_.K + A_ * inverse_change<Real, D>(at_.K, dot.M);
        const Real rate_dot = rate_slope_ * at_.G.cwiseProduct(dG).sum() + pulled_slope_ * change.pull;
        const Real strength_dot = strength_slope_ * rate_dot;
        const Vector<Real, D> out_dot = dot.g + dot.gamma, slope_dot = change.crowd + dot.gamma;
        const Real part_dot =
            (out_dot.dot(at_.slope) + at_.out.dot(slope_dot) - 2 * at_.part * at_.out.dot(out_dot)) / at_.square;
        const Vector<Real, D> along_dot = slope_dot - part_dot * at_.out - at_.part * out_dot;
        const Real grown = strength_dot * shifted_ + strength() * change.shifted;
        const Vector<Real, D> wish_dot = scale_ * (grown * at_.along + strength() * shifted_ * along_dot);
        return bounded(wish_dot + strength_dot * away_ + 4 * strength() * change.apart);
    }

    // From the adjoint of the shift to that of its crowding; adds to that of moments.
    Crowding<Real, D> adjoint(const Vector<Real, D>& delta_bar, Moments<Real, D>& bar) const {
        const Vector<Real, D> both_bar = bounded(delta_bar), wish_bar = scale_ * both_bar;
        const Real along_wish = at_.along.dot(wish_bar);
        const Real strength_bar = shifted_ * along_wish + away_.dot(both_bar);
        const Vector<Real, D> along_bar = strength() * shifted_ * wish_bar;
        const Real part_bar = -at_.out.dot(along_bar) / at_.square;
        const Vector<Real, D> slope_bar = along_bar + part_bar * at_.out;
        const Vector<Real, D> out_bar = part_bar * at_.slope - at_.part * (along_bar + 2 * part_bar * at_.out);
        const Real rate_bar = strength_slope_ * strength_bar;
        const Matrix<Real, D> G_bar = rate_slope_ * rate_bar * at_.G;
        bar.g += out_bar;
        bar.gamma += out_bar + slope_bar;
        bar.M += inverse_change<Real, D>(at_.K, even<Real, D>(A_.transpose() * G_bar));
        return {G_bar * at_.K, slope_bar, strength() * along_wish, pulled_slope_ * rate_bar, 4 * strength() * both_bar};
    }

private:
    Real strength() const { return at_.rate / at_.bend; }
    // The derivative of wish / sqrt(1 + |wish|^2 / farthest^2), which is symmetric.
    Vector<Real, D> bounded(const Vector<Real, D>& change) const {
        const Real square = at_.farthest * at_.farthest * at_.bound * at_.bound;
        return (change - at_.wish.dot(change) / square * at_.wish) / at_.bound;
    }

    Matrix<Real, D> A_;
    Vector<Real, D> away_;  // 4 sum p_ij
    Real shifted_;
    Shift<Real, D> at_;
    // Of r by G : dG and by the pull; of the bounded r by r; -s^2.
    Real rate_slope_, pulled_slope_, strength_slope_, scale_;
};

}  // namespace cortado
