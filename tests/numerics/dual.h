#pragma once

#include <array>
#include <cstddef>

/// Forward-mode differentiation: a value with its derivatives by N unknowns, carried through the rules of calculus.
namespace brdfit::reference {

template <typename T, std::size_t N>
struct Dual {
    T v{};
    std::array<T, N> d{};

    Dual() = default;
    Dual(const T& value) : v(value) {}
    Dual(int value) : v(value) {}
    /// The unknown of that index.
    Dual(const T& value, std::size_t index) : v(value) { d[index] = 1; }

    /// f(x) from its value and df/dx at x.
    [[nodiscard]] Dual through(const T& f, const T& slope) const {
        Dual result(f);
        for (std::size_t i = 0; i < N; ++i) result.d[i] = slope * d[i];
        return result;
    }

    friend Dual operator-(const Dual& a) { return a.through(-a.v, -1); }
    friend Dual operator+(const Dual& a, const Dual& b) {
        Dual result(a.v + b.v);
        for (std::size_t i = 0; i < N; ++i) result.d[i] = a.d[i] + b.d[i];
        return result;
    }
    friend Dual operator-(const Dual& a, const Dual& b) {
        Dual result(a.v - b.v);
        for (std::size_t i = 0; i < N; ++i) result.d[i] = a.d[i] - b.d[i];
        return result;
    }
    friend Dual operator*(const Dual& a, const Dual& b) {
        Dual result(a.v * b.v);
        for (std::size_t i = 0; i < N; ++i) result.d[i] = a.d[i] * b.v + a.v * b.d[i];
        return result;
    }
    friend Dual operator/(const Dual& a, const Dual& b) {
        Dual result(a.v / b.v);
        for (std::size_t i = 0; i < N; ++i) result.d[i] = (a.d[i] - result.v * b.d[i]) / b.v;
        return result;
    }
    Dual& operator+=(const Dual& b) { return *this = *this + b; }
    Dual& operator*=(const Dual& b) { return *this = *this * b; }

    friend bool operator>(const Dual& a, const Dual& b) { return a.v > b.v; }
    friend bool operator==(const Dual& a, const Dual& b) { return a.v == b.v; }

    friend Dual sqrt(const Dual& a) {
        const T root = sqrt(a.v);
        return a.through(root, 1 / (2 * root));
    }
    friend Dual exp(const Dual& a) {
        const T e = exp(a.v);
        return a.through(e, e);
    }
    friend Dual sin(const Dual& a) { return a.through(sin(a.v), cos(a.v)); }
    friend Dual cos(const Dual& a) { return a.through(cos(a.v), -sin(a.v)); }
    friend Dual atan2(const Dual& y, const Dual& x) {
        Dual result(atan2(y.v, x.v));
        const T norm = x.v * x.v + y.v * y.v;
        for (std::size_t i = 0; i < N; ++i) result.d[i] = (x.v * y.d[i] - y.v * x.d[i]) / norm;
        return result;
    }
    /// x > 0.
    friend Dual pow(const Dual& x, const Dual& y) {
        const T power = pow(x.v, y.v);
        const T logarithm = log(x.v);
        Dual result(power);
        for (std::size_t i = 0; i < N; ++i) result.d[i] = power * (y.d[i] * logarithm + y.v / x.v * x.d[i]);
        return result;
    }
};

/// The value alone.
template <typename T>
const T& plain(const T& x) {
    return x;
}
template <typename T, std::size_t N>
const T& plain(const Dual<T, N>& x) {
    return x.v;
}

}  // namespace brdfit::reference
