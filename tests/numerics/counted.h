/// The kernel text as host C++ with numbers that record what is done to them: the vocabulary of kernels/prelude.cl for
/// one lane in double precision. The generated source (host_kernel_generator.cpp, "counted") includes this.
#pragma once

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <span>
#include <string_view>
#include <vector>

namespace brdfit::tests {

enum class Operation : std::uint8_t { none, add, multiply, fma, divide, sqrt };

/// What was done, in its order; operands by their places, from 1. Place 0 is what is given, -1 a constant of the text.
struct Tape {
    struct Entry {
        Operation operation;
        int a, b, c;
    };
    std::vector<Entry> entries;

    int record(Operation operation, int a, int b = -1, int c = -1) {
        entries.push_back({operation, a, b, c});
        return static_cast<int>(entries.size());
    }
    /// How often each operation stands among those that the result needs: a compiler drops the others.
    void count(int result, double* counts) const {
        std::vector<char> needed(entries.size() + 1, 0);
        if (result > 0) needed[static_cast<std::size_t>(result)] = 1;
        for (std::size_t i = entries.size(); i > 0; --i) {
            if (!needed[i]) continue;
            const Entry& entry = entries[i - 1];
            counts[static_cast<std::size_t>(entry.operation)] += 1;
            for (const int operand : {entry.a, entry.b, entry.c})
                if (operand > 0) needed[static_cast<std::size_t>(operand)] = 1;
        }
    }
};
inline Tape tape;  // NOLINT: of one thread

struct Counted {
    double value = 0;
    int place = -1;

    Counted() = default;
    Counted(double v) : value(v) {}  // NOLINT: literals of the text
    Counted(double v, int p) : value(v), place(p) {}
    explicit operator double() const { return value; }
    explicit operator int() const { return static_cast<int>(value); }
};

/// Of constants alone it is a constant.
inline Counted result(Operation operation, double value, Counted a, Counted b, Counted c = {}) {
    if (a.place < 0 && b.place < 0 && c.place < 0) return {value};
    return {value, tape.record(operation, a.place, b.place, c.place)};
}
/// A variable's new value, also where all is known beforehand.
inline Counted& assign(Counted& x, Operation operation, double value, Counted y) {
    x = {value, tape.record(operation, x.place, y.place)};
    return x;
}
inline Counted operator+(Counted x, Counted y) { return result(Operation::add, x.value + y.value, x, y); }
inline Counted operator-(Counted x, Counted y) { return result(Operation::add, x.value - y.value, x, y); }
inline Counted operator*(Counted x, Counted y) { return result(Operation::multiply, x.value * y.value, x, y); }
inline Counted operator/(Counted x, Counted y) { return result(Operation::divide, x.value / y.value, x, y); }
inline Counted operator-(Counted x) { return result(Operation::none, -x.value, x, {}); }
inline Counted& operator+=(Counted& x, Counted y) { return assign(x, Operation::add, x.value + y.value, y); }
inline Counted& operator-=(Counted& x, Counted y) { return assign(x, Operation::add, x.value - y.value, y); }
inline Counted& operator*=(Counted& x, Counted y) { return assign(x, Operation::multiply, x.value * y.value, y); }
inline bool operator<(Counted x, Counted y) { return x.value < y.value; }
inline bool operator>(Counted x, Counted y) { return x.value > y.value; }
inline bool operator<=(Counted x, Counted y) { return x.value <= y.value; }
inline bool operator>=(Counted x, Counted y) { return x.value >= y.value; }
inline Counted fma(Counted x, Counted y, Counted z) {
    return result(Operation::fma, std::fma(x.value, y.value, z.value), x, y, z);
}
inline Counted sqrt(Counted x) { return result(Operation::sqrt, std::sqrt(x.value), x, {}); }
inline Counted fabs(Counted x) { return result(Operation::none, std::fabs(x.value), x, {}); }
inline Counted fmin(Counted x, Counted y) { return result(Operation::none, std::fmin(x.value, y.value), x, y); }
inline Counted fmax(Counted x, Counted y) { return result(Operation::none, std::fmax(x.value, y.value), x, y); }
inline Counted cos(Counted x) { return {std::cos(x.value), x.place}; }  // in kernels that are not counted
inline Counted sin(Counted x) { return {std::sin(x.value), x.place}; }

/// A number's representation.
struct CountedBits {
    std::int64_t value = 0;
    int place = -1;
};
inline CountedBits combined_bits(std::int64_t value, CountedBits a, CountedBits b) {
    return {value, a.place < 0 && b.place < 0 ? -1 : tape.record(Operation::none, a.place, b.place)};
}
inline CountedBits operator+(CountedBits a, CountedBits b) { return combined_bits(a.value + b.value, a, b); }
inline CountedBits operator-(CountedBits a, CountedBits b) { return combined_bits(a.value - b.value, a, b); }
inline CountedBits operator<<(CountedBits a, int n) {
    return {static_cast<std::int64_t>(static_cast<std::uint64_t>(a.value) << n), a.place};
}
inline CountedBits operator>>(CountedBits a, int n) { return {a.value >> n, a.place}; }

/// One model.
struct CountedKernel {
    std::string_view label;  ///< as tests::label() writes it
    /// f at u = (-si, 0, ci), v = (x, y, z), and what it takes, by Operation.
    double (*value)(std::span<const double> parameters, std::span<const double> coefficients,
                    std::span<const double> vectors, double* counts);
};
std::span<const CountedKernel> counted_kernels();

}  // namespace brdfit::tests

#ifdef BRDFIT_COUNTED_KERNEL  // the generated source only
using namespace brdfit::tests;
#define kernel
#define global
#define constant static const
typedef Counted scalar;
typedef Counted real;
typedef int mask;
typedef CountedBits bits;
#define sel(condition, yes, no) ((condition) ? (real)(yes) : (real)(no))
#define any_lane(condition) (condition)
#define load_lanes(pointer) (*(pointer))
#define store_lanes(value, pointer) (*(pointer) = (value))
#define sum_lanes(x) (x)
inline CountedBits as_bits(Counted x) { return {std::bit_cast<std::int64_t>(x.value), x.place}; }
inline Counted as_real(CountedBits x) { return {std::bit_cast<double>(x.value), x.place}; }
inline Counted to_real(CountedBits x) { return {static_cast<double>(x.value), x.place}; }
inline std::size_t get_global_id(int) { return 0; }
inline std::size_t get_global_size(int) { return 1; }
#endif
