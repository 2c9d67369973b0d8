// Common definitions of the kernels. No C++ library headers, so any compiler can build them.
//
// Sums use eight fixed lanes in the same order on every processor without fused operations, so all
// libraries are bit-identical. A kernel returns 0 or an error code: see __init__.py.
#pragma once
#include <stdint.h>

#define KERNEL extern "C" __attribute__((visibility("default"))) int64_t
#define INLINE static inline __attribute__((always_inline))
#define INLINE_MEMBER inline __attribute__((always_inline))

// Input arrays.
typedef const float* Floats;
typedef const int32_t* Ints;
typedef const int64_t* Longs;
typedef const bool* Flagged;

enum Status { DONE = 0, NO_SUCH_ROW = 1, TOO_WIDE = 2 };

constexpr int LANES = 8;
constexpr int MAX_WIDTH = 512;  // values per row: neighbors of a point, points of a patch
constexpr float INFINITE = __builtin_inff();

typedef float FourFloats __attribute__((vector_size(16)));
typedef int32_t FourFlags __attribute__((vector_size(16)));
typedef double TwoDoubles __attribute__((vector_size(16)));

#ifdef __AVX__
typedef float Lanes __attribute__((vector_size(32)));
typedef int32_t Flags __attribute__((vector_size(32)));  // -1 for true
#else
// Two registers of four lanes: GCC compares vectors wider than the hardware lane by lane.
template <class T, class Four>
struct Pair {
  Four low, high;

  INLINE_MEMBER Pair() : low{}, high{} {}
  INLINE_MEMBER Pair(T value) : low(Four{} + value), high(Four{} + value) {}
  INLINE_MEMBER Pair(Four a, Four b) : low(a), high(b) {}
  INLINE_MEMBER T operator[](int lane) const { return lane < 4 ? low[lane] : high[lane - 4]; }
};
typedef Pair<float, FourFloats> Lanes;
typedef Pair<int32_t, FourFlags> Flags;

#define ON_BOTH(Result, operation, Operand)                        \
  INLINE Result operator operation(Operand a, Operand b) {         \
    return Result(a.low operation b.low, a.high operation b.high); \
  }
#define ON_BOTH_ASSIGN(operation, Operand) \
  ON_BOTH(Operand, operation, Operand)     \
  INLINE Operand& operator operation## = (Operand & a, Operand b) { return a = a operation b; }
ON_BOTH_ASSIGN(+, Lanes)
ON_BOTH_ASSIGN(-, Lanes)
ON_BOTH_ASSIGN(*, Lanes)
ON_BOTH_ASSIGN(/, Lanes)
ON_BOTH_ASSIGN(+, Flags)
ON_BOTH_ASSIGN(-, Flags)
ON_BOTH(Flags, &, Flags)
ON_BOTH(Flags, ^, Flags)
ON_BOTH(Flags, |, Flags)
ON_BOTH(Flags, >>, Flags)
ON_BOTH(Flags, <, Lanes)
ON_BOTH(Flags, <=, Lanes)
ON_BOTH(Flags, >, Lanes)
ON_BOTH(Flags, >=, Lanes)
ON_BOTH(Flags, ==, Lanes)
ON_BOTH(Flags, <, Flags)
ON_BOTH(Flags, <=, Flags)
ON_BOTH(Flags, >, Flags)
ON_BOTH(Flags, >=, Flags)
ON_BOTH(Flags, ==, Flags)
INLINE Lanes operator-(Lanes a) { return Lanes(-a.low, -a.high); }
INLINE Flags operator~(Flags a) { return Flags(~a.low, ~a.high); }
#endif

INLINE float square_root(float value) { return __builtin_sqrtf(value); }
INLINE double square_root(double value) { return __builtin_sqrt(value); }
INLINE float size_of(float value) { return __builtin_fabsf(value); }
INLINE double size_of(double value) { return __builtin_fabs(value); }
INLINE bool is_finite(double value) { return __builtin_isfinite(value); }

template <class T>
INLINE T larger(T a, T b) {
  return a < b ? b : a;
}
template <class T>
INLINE T smaller(T a, T b) {
  return b < a ? b : a;
}

INLINE Lanes load(const float* values) {
  Lanes lanes;
  __builtin_memcpy((void*)&lanes, values, sizeof lanes);
  return lanes;
}
INLINE Flags load(const int32_t* values) {
  Flags lanes;
  __builtin_memcpy((void*)&lanes, values, sizeof lanes);
  return lanes;
}
INLINE void store(int32_t* values, Flags lanes) { __builtin_memcpy(values, &lanes, sizeof lanes); }
INLINE void store(float* values, Lanes lanes) { __builtin_memcpy(values, &lanes, sizeof lanes); }
INLINE Lanes all(float value) { return Lanes{} + value; }
#ifdef __AVX__
INLINE Lanes to_float(Flags a) { return __builtin_convertvector(a, Lanes); }
INLINE Lanes where(Flags flags, Lanes a, Lanes b) { return flags ? a : b; }
INLINE Flags where(Flags flags, Flags a, Flags b) { return flags ? a : b; }
#else
INLINE Lanes to_float(Flags a) {
  return Lanes(__builtin_convertvector(a.low, FourFloats),
               __builtin_convertvector(a.high, FourFloats));
}
INLINE Lanes where(Flags flags, Lanes a, Lanes b) {
  return Lanes(flags.low ? a.low : b.low, flags.high ? a.high : b.high);
}
INLINE Flags where(Flags flags, Flags a, Flags b) {
  return Flags(flags.low ? a.low : b.low, flags.high ? a.high : b.high);
}
#endif
INLINE Lanes magnitude(Lanes a) { return where(a < 0, -a, a); }
INLINE Lanes positive(Lanes a) { return where(a > 0, a, all(0)); }
INLINE Lanes larger(Lanes a, Lanes b) { return where(a < b, b, a); }
INLINE Lanes smaller(Lanes a, Lanes b) { return where(b < a, b, a); }
INLINE Flags larger(Flags a, Flags b) { return where(a < b, b, a); }
INLINE Flags smaller(Flags a, Flags b) { return where(b < a, b, a); }

INLINE int total(Flags a) {
  return ((a[0] + a[4]) + (a[2] + a[6])) + ((a[1] + a[5]) + (a[3] + a[7]));
}
INLINE Lanes one_where(Flags flags) { return where(flags, all(1), all(0)); }
// Whether a lane is negative, such as true.
INLINE bool is_any(Flags flags) {
#ifdef __AVX__
  return __builtin_ia32_movmskps256((Lanes)flags) != 0;
#elif defined(__SSE__)
  return __builtin_ia32_movmskps((FourFloats)(flags.low | flags.high)) != 0;
#else
  return total(flags >> 31) != 0;
#endif
}
INLINE Lanes roots_of(Lanes squares) {
  float lanes[LANES];
  store(lanes, squares);
  for (float& lane : lanes) lane = square_root(lane);
  return load(lanes);
}
INLINE int padded(int count) { return (count + LANES - 1) / LANES * LANES; }

// Whether all numbers are valid rows in [0, num_rows).
INLINE bool is_row(int32_t number, int64_t num_rows) {
  return (number >= 0) & (int64_t(number) < num_rows);
}
INLINE bool are_rows(const int32_t* numbers, int64_t count, int64_t num_rows) {
  uint32_t highest = 0;
  for (int64_t j = 0; j < count; j++) highest = larger(highest, uint32_t(numbers[j]));
  return count < 1 || (highest <= uint32_t(INT32_MAX) && int64_t(highest) < num_rows);
}
