// Smoothing kernels W(x; h) with q = |x| / h (cubic spline: Monaghan 1992; Wendland C2, C4: Dehnen and Aly 2012).
#pragma once

#include <stdexcept>
#include <string>

#include "scalar.hpp"

namespace cortado {

// W = sigma w(q), grad W = a x, H u = a u + b (x . u) x; all 0 from q = 1 on.
template <class Scalar>
struct Smoothing {
    using Real = typename RealOf<Scalar>::type;
    enum class Form { cubic_spline, wendland_c2, wendland_c4 } form;
    Scalar h, one_over_h, sigma, sigma_2, sigma_4;  // sigma_2 = sigma / h^2, sigma_4 = sigma / h^4
    Real h_squared;

    Smoothing(const std::string& name, double support, double normalisation)
        : form(name == "cubic_spline"  ? Form::cubic_spline
               : name == "wendland_c2" ? Form::wendland_c2
               : name == "wendland_c4" ? Form::wendland_c4
                                       : throw std::invalid_argument("kernel " + name + " is unknown")),
          h(Real(support)),
          one_over_h(Real(1) / Real(support)),
          sigma(Real(normalisation)),
          sigma_2(sigma * one_over_h * one_over_h),
          sigma_4(sigma_2 * one_over_h * one_over_h),
          h_squared(Real(support) * Real(support)) {}

    bool near(const Scalar& r_squared) const { return real_part(r_squared) < h_squared; }
    // At q = 0 its derivative is put to 0: W and a are even in x, so that nothing is lost.
    Scalar q_of(const Scalar& r_squared) const { return square_root(r_squared) * one_over_h; }

    Scalar weight(const Scalar& q) const {
        const Scalar one(Real(1)), t = one - q;
        switch (form) {
            case Form::cubic_spline:
                if (real_part(q) <= Real(0.5)) return sigma * (Scalar(Real(6)) * q * q * (q - one) + one);
                return sigma * (Scalar(Real(2)) * t * t * t);
            case Form::wendland_c2: {
                const Scalar t_2 = t * t;
                return sigma * (t_2 * t_2 * (one + Scalar(Real(4)) * q));
            }
            default: {
                const Scalar t_2 = t * t;
                return sigma * (t_2 * t_2 * t_2 * (one + Scalar(Real(6)) * q + Scalar(Real(35) / Real(3)) * q * q));
            }
        }
    }

    // a = sigma / h^2 w'(q) / q
    Scalar slope(const Scalar& q) const {
        const Scalar one(Real(1)), t = one - q;
        switch (form) {
            case Form::cubic_spline:
                if (real_part(q) <= Real(0.5)) return sigma_2 * (Scalar(Real(18)) * q - Scalar(Real(12)));
                return sigma_2 * (Scalar(Real(-6)) * t * t / q);
            case Form::wendland_c2:
                return sigma_2 * (Scalar(Real(-20)) * t * t * t);
            default: {
                const Scalar t_2 = t * t;
                return sigma_2 * (Scalar(Real(-56) / Real(3)) * (one + Scalar(Real(5)) * q) * t_2 * t_2 * t);
            }
        }
    }

    // b = sigma / h^4 (w'(q) / q)' / q; where particles coincide x = 0 and H = a I, so that 0 stands for a pole.
    Scalar bend(const Scalar& q) const {
        if (real_part(q) == Real(0)) return Scalar(Real(0));
        const Scalar t = Scalar(Real(1)) - q;
        switch (form) {
            case Form::cubic_spline:
                if (real_part(q) <= Real(0.5)) return sigma_4 * (Scalar(Real(18)) / q);
                return sigma_4 * (Scalar(Real(6)) * t * (Scalar(Real(2)) * q + t) / (q * q * q));
            case Form::wendland_c2:
                return sigma_4 * (Scalar(Real(60)) * t * t / q);
            default: {
                const Scalar t_2 = t * t;
                return sigma_4 * (Scalar(Real(560)) * t_2 * t_2);
            }
        }
    }
};

}  // namespace cortado
