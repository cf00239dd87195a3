// Numbers: the reals in four precisions, and numbers a + b u with u^2 = 0 (dual) or u^2 = -1 (complex).
#pragma once

#include <Eigen/Core>
#include <cmath>
#include <limits>
#ifdef CORTADO_HAS_FLOAT128
#include <quadmath.h>
#endif

namespace cortado {

// ---- reals -----------------------------------------------------------------------------------------------------

template <class Real>
Real square_root(Real a) {
    return std::sqrt(a);
}
template <class Real>
Real nearest_integer(Real a) {
    return std::round(a);
}
#ifdef CORTADO_HAS_FLOAT128
template <>
inline __float128 square_root(__float128 a) {
    return sqrtq(a);
}
template <>
inline __float128 nearest_integer(__float128 a) {
    return roundq(a);
}
#endif

// The greatest whole number that is not above a.
template <class Real>
Real whole_below(const Real& a) {
    const Real near = nearest_integer(a);
    return near > a ? Real(near - Real(1)) : near;
}

// The relative distance between neighbouring numbers; std::numeric_limits leaves __float128 out in strict modes.
template <class Real>
Real epsilon() {
    Real e = 1;
    while (Real(1) + e / 2 > Real(1)) e /= 2;
    return e;
}

// ---- numbers a + b u -------------------------------------------------------------------------------------------

// Square is u^2. Comparisons are by a alone, so that clamps and lists are those of the real run.
template <class Base, int Square>
struct Extended {
    using Real = Base;
    Base a{}, b{};

    Extended() = default;
    Extended(Base a, Base b = Base(0)) : a(a), b(b) {}
    template <class Number, class = std::enable_if_t<std::is_arithmetic_v<Number> && !std::is_same_v<Number, Base>>>
    Extended(Number a) : a(Base(a)), b(0) {}

    Extended& operator+=(const Extended& o) { return *this = *this + o; }
    Extended& operator-=(const Extended& o) { return *this = *this - o; }
    Extended& operator*=(const Extended& o) { return *this = *this * o; }
    Extended& operator/=(const Extended& o) { return *this = *this / o; }

    friend Extended operator-(const Extended& x) { return {-x.a, -x.b}; }
    friend Extended operator+(const Extended& x, const Extended& y) { return {x.a + y.a, x.b + y.b}; }
    friend Extended operator-(const Extended& x, const Extended& y) { return {x.a - y.a, x.b - y.b}; }
    friend Extended operator*(const Extended& x, const Extended& y) {
        if constexpr (Square == 0) return {x.a * y.a, x.a * y.b + x.b * y.a};
        return {x.a * y.a + Base(Square) * (x.b * y.b), x.a * y.b + x.b * y.a};
    }
    friend Extended operator/(const Extended& x, const Extended& y) {
        if constexpr (Square == 0) {
            const Base quotient = x.a / y.a;
            return {quotient, (x.b - quotient * y.b) / y.a};
        }
        const Base size = y.a * y.a - Base(Square) * (y.b * y.b);
        return {(x.a * y.a - Base(Square) * (x.b * y.b)) / size, (x.b * y.a - x.a * y.b) / size};
    }
    friend bool operator<(const Extended& x, const Extended& y) { return x.a < y.a; }
    friend bool operator>(const Extended& x, const Extended& y) { return x.a > y.a; }
    friend bool operator<=(const Extended& x, const Extended& y) { return x.a <= y.a; }
    friend bool operator>=(const Extended& x, const Extended& y) { return x.a >= y.a; }
};

template <class Real>
using Dual = Extended<Real, 0>;
template <class Real>
using Complex = Extended<Real, -1>;

// A root with a positive real part; of a number that is 0 in its real part it is 0, see `Smoothing`.
template <class Base, int Square>
Extended<Base, Square> square_root(const Extended<Base, Square>& x) {
    if (!(x.a > Base(0))) return {square_root(x.a)};
    if constexpr (Square == 0) {
        const Base root = square_root(x.a);
        return {root, x.b / (Base(2) * root)};
    }
    const Base root = square_root((x.a + square_root(x.a * x.a + x.b * x.b)) / Base(2));
    return {root, x.b / (Base(2) * root)};
}

template <class Real>
const Real& real_part(const Real& x) {
    return x;
}
template <class Base, int Square>
const Base& real_part(const Extended<Base, Square>& x) {
    return x.a;
}

template <class Scalar>
struct RealOf {
    using type = Scalar;
};
template <class Base, int Square>
struct RealOf<Extended<Base, Square>> {
    using type = Base;
};

}  // namespace cortado

namespace Eigen {

template <class Base, int Square>
struct NumTraits<cortado::Extended<Base, Square>> : NumTraits<Base> {
    using Real = cortado::Extended<Base, Square>;
    using NonInteger = Real;
    using Nested = Real;
    using Literal = Real;
    enum { IsComplex = 0, IsInteger = 0, IsSigned = 1, RequireInitialization = 1, ReadCost = 2, AddCost = 2, MulCost = 4 };
};

}  // namespace Eigen
