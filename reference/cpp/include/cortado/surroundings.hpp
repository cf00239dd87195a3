// What a particle's neighbourhood lets the projection do, from the moments of its neighbours, and how far it is
// shifted. docs/projection.md has the formulas, by the same letters.
#pragma once

#include "images.hpp"
#include "stress.hpp"

namespace cortado {

template <class Scalar>
Scalar hundredths(int count) {
    using Real = typename RealOf<Scalar>::type;
    return Scalar(Real(count) / Real(100));
}

// M = -sum g_ij x_ij^T, Q = sum g_ij g_ij^T / m and g = sum g_ij of fluid; of walls the sums of g_ib, along their
// normals and whole, gamma, which is between the two, and nu, and of walls that mirror the sum along normals and nu; of
// images sum V W.
template <class Scalar, int D>
struct Moments {
    Matrix<Scalar, D> M = Matrix<Scalar, D>::Constant(Scalar(0)), Q = M;
    Vector<Scalar, D> g = Vector<Scalar, D>::Constant(Scalar(0)), normal = g, whole = g, gamma = g;
    Vector<Scalar, D> mirror = g;
    Scalar nu{0}, behind{0}, images{0};
};

// What follows from them: L, the diagonal a, and how much tension is let through (sigma), how full it is (f), how much
// is shifted and repaired, its share c of a coarse pressure, how much images count (h), and along what walls push then.
template <class Scalar, int D>
struct Effects {
    Matrix<Scalar, D> L = Matrix<Scalar, D>::Constant(Scalar(0));
    Scalar a{0}, tension{0}, full{0}, shifted{0}, repaired{0}, shared{0}, image{0};
    Vector<Scalar, D> push = Vector<Scalar, D>::Constant(Scalar(0));
};

// 0 below a first number, 1 above a second one, and a cubic between them; numbers are in hundredths.
template <class Scalar>
struct Smoothstep {
    Scalar value{0}, slope{0};

    Smoothstep(const Scalar& at, int first, int second) {
        const Scalar width = hundredths<Scalar>(second - first), t = (at - hundredths<Scalar>(first)) / width, one(1);
        if (!(t > Scalar(0))) return;
        if (!(t < one)) {
            value = one;
            return;
        }
        value = t * t * (Scalar(3) - Scalar(2) * t);
        slope = Scalar(6) * t * (one - t) / width;
    }
};

// How much of the whole push of walls counts: none along flat walls, all of it about an edge that sticks out.
template <class Scalar, int D>
struct Edge {
    Vector<Scalar, D> normal, whole;
    Scalar below, off;
    Smoothstep<Scalar> share;

    Edge(const Model<Scalar, D>& model, const Moments<Scalar, D>& of)
        : normal(of.normal),
          whole(of.whole),
          below(of.whole.dot(of.whole) + hundredths<Scalar>(1) * model.least_diagonal),
          off((of.whole.dot(of.whole) - of.normal.dot(of.normal)) / below),
          share(off, 10, 40) {}

    Vector<Scalar, D> gamma() const { return normal + share.value * (whole - normal); }

    // The tangent of gamma for those of the sums along normals and whole.
    Vector<Scalar, D> tangent(const Vector<Scalar, D>& dn, const Vector<Scalar, D>& dw) const {
        const Scalar two(2), doff = (two * (Scalar(1) - off) * whole.dot(dw) - two * normal.dot(dn)) / below;
        return dn + share.value * (dw - dn) + (share.slope * doff) * (whole - normal);
    }

    // Adds to the adjoints of the sums for that of gamma.
    void adjoint(Moments<Scalar, D>& bar) const {
        const Scalar one(1), off_bar = Scalar(2) * share.slope * bar.gamma.dot(whole - normal) / below;
        bar.normal += (one - share.value) * bar.gamma - off_bar * normal;
        bar.whole += share.value * bar.gamma + off_bar * (one - off) * whole;
    }
};

// H = D det M / (the invariant of order D - 1), and its gradient.
template <class Scalar, int D>
struct Filling {
    Scalar H;
    Matrix<Scalar, D> slope;

    explicit Filling(const Matrix<Scalar, D>& M) {
        using Real = typename RealOf<Scalar>::type;
        const Second<Scalar, D> second(M);
        const Scalar below = second.value + Scalar(Real(1) / Real(1e12)), dimension(D);
        H = dimension * M.determinant() / below;
        Matrix<Scalar, D> cofactors = M.trace() * Matrix<Scalar, D>::Identity() - M;
        if constexpr (D == 3) cofactors = M * M - M.trace() * M + second.value * Matrix<Scalar, D>::Identity();
        slope = (dimension * cofactors - H * second.slope) / below;
    }
};

// 1.05 (M + 0.05)^-1
template <class Scalar, int D>
Matrix<Scalar, D> regular_inverse(const Matrix<Scalar, D>& M) {
    const Matrix<Scalar, D> unit = Matrix<Scalar, D>::Identity(), sum = M + hundredths<Scalar>(5) * unit;
    return hundredths<Scalar>(105) * sum.inverse();
}

// Of 1.05 (M + 0.05)^-1 = J, how much of J (J - 1) brings it nearer to the inverse of M inside of the fluid.
template <class Scalar>
Scalar newton() {
    return hundredths<Scalar>(33) / Scalar(10);
}

// B of nu: 1, and 0 beside walls; and its derivative.
template <class Scalar>
struct Away {
    Scalar value, slope;

    Away(const Scalar& nu, const Scalar& half) {
        const Scalar one(1), ratio = nu / half;
        value = one / (one + ratio * ratio * ratio * ratio);
        slope = Scalar(-4) * value * value * ratio * ratio * ratio / half;
    }
};

// The effects of moments, with what is between them.
template <class Scalar, int D>
struct Surroundings {
    Filling<Scalar, D> filling;
    Smoothstep<Scalar> tension, full, corrected, shifted, repaired, shared, image;
    Away<Scalar> alone;       // q: 0 beside walls that do not mirror
    Away<Scalar> away, open;  // B of nu + 9 q nu of walls that mirror, and without q nu of them
    Scalar behind;            // nu of walls that mirror + 1e-6
    Vector<Scalar, D> leaning;  // gamma of others
    Scalar direction, lean;   // the denominators of N and C
    Scalar below, lack;       // M : P / (d - 1) + 0.05, and t
    Matrix<Scalar, D> J, K, N, P, C;
    Matrix<Scalar, D> late;    // 0.033 J (J - 1)
    Matrix<Scalar, D> beside;  // t P - (1 + t) C
    Matrix<Scalar, D> bare;   // (L - 1) / c
    Vector<Scalar, D> own;    // L g + gamma
    Effects<Scalar, D> found;

    Surroundings(const Model<Scalar, D>& model, const Moments<Scalar, D>& of)
        : filling(of.M),
          tension(filling.H, 10, 50),
          full(Scalar(filling.H + of.nu), 10, 50),
          corrected(filling.H, 20, 50),
          shifted(filling.H, 50, 80),
          repaired(filling.H, 80, 95),
          shared(Scalar(filling.H + of.nu + of.nu), 70, 95),
          image(Scalar(of.images / (of.behind + hundredths<Scalar>(1) / Scalar(10000))), 70, 90),
          alone(Scalar(of.nu - of.behind), Scalar(hundredths<Scalar>(1) / Scalar(2))),
          away(Scalar(of.nu + Scalar(9) * alone.value * of.behind), hundredths<Scalar>(5)),
          open(Scalar(of.nu - alone.value * of.behind), hundredths<Scalar>(5)),
          behind(of.behind + hundredths<Scalar>(1) / Scalar(10000)),
          leaning(of.gamma - alone.value * of.mirror) {
        const Scalar one(1), m = model.rest_density;
        const Matrix<Scalar, D> unit = Matrix<Scalar, D>::Identity();
        J = regular_inverse<Scalar, D>(of.M);
        late = newton<Scalar>() * J * (J - unit);
        K = J + repaired.value * late;
        direction = leaning.dot(leaning) + hundredths<Scalar>(1) * model.least_diagonal;
        N = leaning * leaning.transpose() / direction;
        lean = of.M.cwiseProduct(N).sum() + hundredths<Scalar>(5);
        const Matrix<Scalar, D> across = (unit - N) * of.M * N;
        C = hundredths<Scalar>(105) / lean * (across + across.transpose());
        P = unit - N;
        below = of.M.cwiseProduct(P).sum() / Scalar(D - 1) + hundredths<Scalar>(5);
        lack = hundredths<Scalar>(20) * (hundredths<Scalar>(105) / below - one);
        beside = lack * P - (one + lack) * C;
        bare = away.value * (K - unit) + (one - open.value) * beside;
        found.L = unit + corrected.value * bare;
        own = found.L * of.g + of.gamma;
        found.a = (own.dot(own) + model.least_diagonal) / m + (found.L * found.L).cwiseProduct(of.Q).sum();
        found.tension = tension.value * away.value;
        found.full = full.value;
        found.shifted = shifted.value;
        found.repaired = repaired.value * away.value;
        found.shared = shared.value;
        found.image = image.value * alone.value;
        found.push = of.gamma - found.image * of.mirror;
    }
};

// How fast a particle is shifted whose pressure p pulls, 60 c^2 / (c + 0.004)^1.5 with c = dt^2 max(-p, 0) / (rho s^2),
// of `pull` = dt p by the weight of low densities in repairs; and its derivative by `pull`.
template <class Scalar, int D>
struct Pulled {
    Scalar rate{0}, slope{0};

    Pulled(const Model<Scalar, D>& model, const Scalar& pull) {
        using Real = typename RealOf<Scalar>::type;
        if (!(real_part(pull) < Real(0))) return;
        const Scalar per = -model.time_step / (model.rest_density * model.spacing * model.spacing);
        const Scalar c = per * pull, weak = hundredths<Scalar>(2) / Scalar(5), above = c + weak;
        const Scalar below = above * square_root(above);
        rate = Scalar(60) * c * c / below;
        slope = Scalar(30) * c * (c + Scalar(4) * weak) / (below * above) * per;
    }
};

// p_ij = w^2 x_ij with w = max(1 - |x_ij|^2 / (0.65 s)^2, 0), which moves pairs apart that are near.
template <class Scalar, int D>
class Apart {
public:
    Apart(const Model<Scalar, D>& model, const Vector<Scalar, D>& x) : x_(x) {
        const Scalar nearest = hundredths<Scalar>(65) * model.spacing;
        per_ = Scalar(1) / (nearest * nearest);
        const Scalar left = Scalar(1) - per_ * x.dot(x);
        if (left > Scalar(0)) w_ = left;
    }

    Vector<Scalar, D> value() const { return (w_ * w_) * x_; }
    // Its derivative along a change of x_ij, a symmetric matrix times it.
    Vector<Scalar, D> along(const Vector<Scalar, D>& change) const {
        return w_ * (w_ * change - (Scalar(4) * per_ * x_.dot(change)) * x_);
    }

private:
    Vector<Scalar, D> x_;
    Scalar per_, w_{0};
};

// How far a particle is shifted, from A = sum v_ij g_ij^T, the crowd of its neighbours, sum (1 + ...) g_ij,
// how much it is pulled, and sum p_ij, by which it is moved away from others.
template <class Scalar, int D>
struct Shift {
    Matrix<Scalar, D> K, G;
    Scalar root, rate, bend;        // sqrt(dt^2 |G|^2 + e^2), r before it is bounded, sqrt(1 + (r / 0.5)^2)
    Vector<Scalar, D> out, slope, along;
    Scalar square, part;            // of out; of slope along it
    Vector<Scalar, D> wish, delta;
    Scalar farthest, bound;         // [m]; sqrt(1 + |wish|^2 / farthest^2)

    Shift(const Model<Scalar, D>& model, const Moments<Scalar, D>& of, const Scalar& shifted,
          const Matrix<Scalar, D>& A, const Vector<Scalar, D>& crowd, const Scalar& pull,
          const Vector<Scalar, D>& apart) {
        using Real = typename RealOf<Scalar>::type;
        const Scalar one(1), dt = model.time_step, s = model.spacing, least(Real(1) / Real(1e5));
        K = regular_inverse<Scalar, D>(of.M);
        G = A * K;
        const Scalar turned = dt * dt * G.cwiseProduct(G).sum();
        root = square_root(Scalar(turned + least * least));
        rate = Scalar(20) * turned / (root + least) + Pulled<Scalar, D>(model, pull).rate;
        bend = square_root(Scalar(one + Scalar(4) * rate * rate));
        out = of.g + of.gamma;
        slope = crowd + of.gamma;
        square = out.dot(out) + hundredths<Scalar>(3) * hundredths<Scalar>(3) / (s * s);
        part = out.dot(slope) / square;
        along = slope - part * out;
        wish = rate / bend * (Scalar(4) * apart - s * s * shifted * along);
        farthest = s / Scalar(10);
        bound = square_root(Scalar(one + wish.dot(wish) / (farthest * farthest)));
        delta = wish / bound;
    }
};

// 1 + q / (4 + q) with q = (W_ij / W(s))^4, and its derivative by V W_ij.
template <class Scalar>
struct Closeness {
    Scalar value, slope;

    Closeness(const Scalar& weight, const Scalar& nearest) {
        const Scalar near = weight / nearest, cube = near * near * near, below = Scalar(4) + cube * near;
        value = Scalar(1) + cube * near / below;
        slope = Scalar(16) * cube / (below * below * nearest);
    }
};

}  // namespace cortado
