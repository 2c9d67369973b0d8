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
typedef const double* Doubles;
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
  INLINE_MEMBER Pair operator-() const { return {-low, -high}; }
  INLINE_MEMBER Pair operator~() const { return {~low, ~high}; }

#define ON_BOTH(Result, operation)                                 \
  friend INLINE_MEMBER Result operator operation(Pair a, Pair b) { \
    return {a.low operation b.low, a.high operation b.high};       \
  }
#define ON_BOTH_ASSIGN(operation) \
  ON_BOTH(Pair, operation)        \
  friend INLINE_MEMBER Pair& operator operation## = (Pair & a, Pair b) { return a = a operation b; }
  typedef Pair<int32_t, FourFlags> Compared;
  ON_BOTH_ASSIGN(+)
  ON_BOTH_ASSIGN(-)
  ON_BOTH_ASSIGN(*)
  ON_BOTH_ASSIGN(/)
  ON_BOTH_ASSIGN(&)
  ON_BOTH_ASSIGN(|)
  ON_BOTH(Pair, ^)
  ON_BOTH(Pair, >>)
  ON_BOTH(Compared, <)
  ON_BOTH(Compared, <=)
  ON_BOTH(Compared, >)
  ON_BOTH(Compared, >=)
  ON_BOTH(Compared, ==)
};
typedef Pair<float, FourFloats> Lanes;
typedef Pair<int32_t, FourFlags> Flags;
#endif

INLINE float square_root(float value) { return __builtin_sqrtf(value); }
INLINE double square_root(double value) { return __builtin_sqrt(value); }
INLINE float size_of(float value) { return __builtin_fabsf(value); }
INLINE double size_of(double value) { return __builtin_fabs(value); }
INLINE bool is_finite(double value) { return __builtin_isfinite(value); }

// Copies bytes.
template <class To>
INLINE To read_as(const void* bytes) {
  To found;
  __builtin_memcpy((void*)&found, bytes, sizeof found);
  return found;
}
INLINE Lanes load(const float* values) { return read_as<Lanes>(values); }
INLINE Flags load(const int32_t* values) { return read_as<Flags>(values); }
INLINE void store(int32_t* values, Flags lanes) { __builtin_memcpy(values, &lanes, sizeof lanes); }
INLINE void store(float* values, Lanes lanes) { __builtin_memcpy(values, &lanes, sizeof lanes); }

// Numbers, or lanes of them.
template <class Flag, class T>
INLINE T where(Flag flags, T a, T b) {
  return flags ? a : b;
}
#ifdef __AVX__
INLINE Lanes to_float(Flags a) { return __builtin_convertvector(a, Lanes); }
#else
template <class T, class Four>
INLINE Pair<T, Four> where(Flags flags, Pair<T, Four> a, Pair<T, Four> b) {
  return {flags.low ? a.low : b.low, flags.high ? a.high : b.high};
}
INLINE Lanes to_float(Flags a) {
  return {__builtin_convertvector(a.low, FourFloats), __builtin_convertvector(a.high, FourFloats)};
}
#endif
template <class T>
INLINE T larger(T a, T b) {
  return where(a < b, b, a);
}
template <class T>
INLINE T smaller(T a, T b) {
  return where(b < a, b, a);
}
template <class T>
INLINE T magnitude(T a) {
  return where(a < 0, -a, a);
}
INLINE Lanes all(float value) { return Lanes{} + value; }
INLINE Lanes positive(Lanes a) { return where(a > 0, a, all(0)); }
INLINE Lanes or_one(Lanes a) { return where(a > 0, a, all(1)); }
INLINE Lanes one_where(Flags flags) { return where(flags, all(1), all(0)); }
INLINE Lanes side_where(Flags flags) { return where(flags, all(1), all(-1)); }

// Whether a lane is negative, such as true.
template <class Vector>
INLINE bool is_any(Vector flags) {
  auto any = flags[0];
  for (int lane = 1; lane < int(sizeof flags / sizeof any); lane++) any |= flags[lane];
  return any < 0;
}
#ifdef __SSE__
INLINE bool is_any(Flags flags) {
#ifdef __AVX__
  return __builtin_ia32_movmskps256((Lanes)flags) != 0;
#else
  return __builtin_ia32_movmskps((FourFloats)(flags.low | flags.high)) != 0;
#endif
}
#endif
INLINE Lanes roots_of(Lanes squares) {
  float lanes[LANES];
  store(lanes, squares);
  for (float& lane : lanes) lane = square_root(lane);
  return load(lanes);
}

// Eight vectors.
struct Vectors {
  Lanes x{}, y{}, z{};
};
INLINE Vectors operator-(const Vectors& a, const Vectors& b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
INLINE Vectors operator*(Lanes factor, const Vectors& a) {
  return {factor * a.x, factor * a.y, factor * a.z};
}
INLINE Vectors operator/(const Vectors& a, Lanes divisor) {
  return {a.x / divisor, a.y / divisor, a.z / divisor};
}
INLINE Lanes dot(const Vectors& a, const Vectors& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
INLINE Vectors where(Flags flags, const Vectors& a, const Vectors& b) {
  return {where(flags, a.x, b.x), where(flags, a.y, b.y), where(flags, a.z, b.z)};
}

INLINE int padded(int count) { return (count + LANES - 1) / LANES * LANES; }

// Whether a number is a row.
INLINE bool is_row(int64_t number, int64_t num_rows) {
  return uint64_t(number) < uint64_t(num_rows);
}
// Whether all numbers are.
template <class T>
INLINE bool are_rows(const T* numbers, int64_t count, int64_t num_rows) {
  const int64_t limit = sizeof(T) == 4 ? INT32_MAX : INT64_MAX, last = smaller(num_rows - 1, limit);
  T wrong = 0;  // in its sign, without a branch
  for (int64_t j = 0; j < count; j++)
    wrong |= numbers[j] | T(uint64_t(last) - uint64_t(numbers[j]));
  return wrong >= 0;
}
