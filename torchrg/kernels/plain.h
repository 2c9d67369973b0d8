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

#ifdef __AVX__
typedef float Lanes __attribute__((vector_size(32)));
typedef int32_t Flags __attribute__((vector_size(32)));  // -1 for true
#else
// Two registers of four lanes: GCC compares vectors wider than the hardware lane by lane.
typedef float FourFloats __attribute__((vector_size(16)));
typedef int32_t FourFlags __attribute__((vector_size(16)));

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

INLINE float total(Lanes a) {
  return ((a[0] + a[4]) + (a[2] + a[6])) + ((a[1] + a[5]) + (a[3] + a[7]));
}
INLINE int total(Flags a) {
  return ((a[0] + a[4]) + (a[2] + a[6])) + ((a[1] + a[5]) + (a[3] + a[7]));
}
INLINE float largest(Lanes a) {
  float maximum = a[0];
  for (int lane = 1; lane < LANES; lane++) maximum = larger(maximum, a[lane]);
  return maximum;
}
INLINE int padded(int count) { return (count + LANES - 1) / LANES * LANES; }

// Neighbors relative to the first one, with weights; padding lanes have weight 0.
struct Patch {
  alignas(32) float x[MAX_WIDTH], y[MAX_WIDTH], z[MAX_WIDTH], weight[MAX_WIDTH];
  int width;

  INLINE_MEMBER Lanes along(float a, float b, float c, int j) const {
    return load(x + j) * a + load(y + j) * b + load(z + j) * c;
  }
  INLINE_MEMBER Lanes sq_lengths(int j) const {
    Lanes u = load(x + j), v = load(y + j), w = load(z + j);
    return u * u + v * v + w * w;
  }
};

// Whether all numbers are valid rows in [0, num_rows).
INLINE bool is_row(int32_t number, int64_t num_rows) {
  return (number >= 0) & (int64_t(number) < num_rows);
}
INLINE bool are_rows(const int32_t* numbers, int64_t count, int64_t num_rows) {
  const uint32_t end = uint32_t(smaller(num_rows, int64_t(INT32_MAX) + 1));
  bool inside = true;
  for (int64_t j = 0; j < count; j++) inside &= uint32_t(numbers[j]) < end;
  return inside;
}

// Points (N, 3), neighbor lists of length k, and an optional mask of counted neighbors.
struct Lists {
  int64_t num_points, num_lists, k;
  const float* points;
  const int32_t* indices;
  const bool* mask;
};

// Gathers the neighbors of a list; false if an index is out of range.
INLINE bool gather(const Lists& lists, int64_t i, Patch& patch) {
  const int k = int(lists.k);
  const float* points = lists.points;
  const int32_t* row = lists.indices + i * k;
  const bool* mask = lists.mask ? lists.mask + i * k : nullptr;
  if (!are_rows(row, k, lists.num_points)) return false;
  const float* first = points + 3 * int64_t(row[0]);
  const float x0 = first[0], y0 = first[1], z0 = first[2];
  for (int j = 0; j < k; j++) {
    const float* point = points + 3 * int64_t(row[j]);
    patch.x[j] = point[0] - x0, patch.y[j] = point[1] - y0, patch.z[j] = point[2] - z0;
    patch.weight[j] = 1;
  }
  if (mask)
    for (int j = 0; j < k; j++)
      if (!mask[j]) patch.x[j] = patch.y[j] = patch.z[j] = patch.weight[j] = 0;
  patch.width = padded(k);
  for (int j = k; j < patch.width; j++) patch.x[j] = patch.y[j] = patch.z[j] = patch.weight[j] = 0;
  return true;
}

// Calls `visit` with each index, its row and its patch, for all lists or n rows.
template <class Visit>
INLINE int64_t visit_patches(const Lists& lists, Longs rows, int64_t n, const Visit& visit) {
  if (lists.k < 1 || lists.k > MAX_WIDTH) return TOO_WIDE;
  Patch patch;
  for (int64_t q = 0; q < n; q++) {
    const int64_t i = rows ? rows[q] : q;
    if (i < 0 || i >= lists.num_lists || !gather(lists, i, patch)) return NO_SUCH_ROW;
    visit(q, i, patch);
  }
  return DONE;
}

// A plane normal . q = offset, and the eigenvalues of its covariance.
struct Plane {
  float a, b, c, offset;
  double low, middle, high;

  INLINE_MEMBER Lanes residuals(const Patch& patch, int j) const {
    return patch.along(a, b, c, j) - offset;
  }
};

// Writes the normal of a plane to row i of (n, 3).
INLINE void write(const Plane& plane, float* normals, int64_t i) {
  normals[3 * i] = plane.a, normals[3 * i + 1] = plane.b, normals[3 * i + 2] = plane.c;
}

struct Vector {
  double x, y, z;
};

INLINE Vector unit(Vector v) {
  const double length = square_root(v.x * v.x + v.y * v.y + v.z * v.z);
  return {v.x / length, v.y / length, v.z / length};
}

// torchrg.linalg.eigen._across: a unit vector orthogonal to the direction of a rank-one matrix.
static Vector across(Vector first, Vector second, Vector third) {
  Vector row = second.y > first.x ? second : first;
  if (third.z > larger(first.x, second.y)) row = third;
  const double sizes[3] = {size_of(row.x), size_of(row.y), size_of(row.z)};
  const bool is_z = sizes[2] < smaller(sizes[0], sizes[1]), is_y = !is_z && sizes[1] < sizes[0];
  const double i = !is_y && !is_z, j = is_y, k = is_z;
  const Vector found = {row.y * k - row.z * j, row.z * i - row.x * k, row.x * j - row.y * i};
  const double length = square_root(found.x * found.x + found.y * found.y + found.z * found.z);
  return length > 0 ? unit(found) : Vector{i, j, k};
}

// torchrg.linalg.smallest_eigenvector3, bit-identical, of the covariance xx xy xz yy yz zz.
INLINE void decompose(const float* covariance, Plane& plane) {
  constexpr int FIRST_STEPS = 4, STEPS = 40;
  constexpr double CONVERGED = 1e-9, NEARLY_EQUAL = 1e-9;
  float scale = 0;
  for (int i = 0; i < 6; i++) scale = larger(scale, size_of(covariance[i]));
  const double safe = scale > 0 ? scale : 1;
  const double xx = covariance[0] / safe, xy = covariance[1] / safe, xz = covariance[2] / safe,
               yy = covariance[3] / safe, yz = covariance[4] / safe, zz = covariance[5] / safe;
  const double trace = xx + yy + zz;
  const double minors = xx * yy - xy * xy + (xx * zz - xz * xz) + (yy * zz - yz * yz);
  const double determinant =
      zz * (xx * yy - xy * xy) - yz * (xx * yz - xy * xz) + xz * (xy * yz - yy * xz);
  double root = 0;
  for (int i = 0; i < STEPS; i++) {
    const double value = ((root - trace) * root + minors) * root - determinant;
    const double slope = (3 * root - 2 * trace) * root + minors;
    double step = value / slope;
    if (!is_finite(step)) step = 0;
    root -= step;
    if (i + 1 >= FIRST_STEPS && !(size_of(step) > CONVERGED * trace)) break;
  }
  const double x = xx - root, y = yy - root, z = zz - root;
  const double a = y * z - yz * yz, b = x * z - xz * xz, c = x * y - xy * xy;
  const double ab = xz * yz - xy * z, ac = xy * yz - xz * y, bc = xy * xz - x * yz;
  Vector normal = b > a ? Vector{ab, b, bc} : Vector{a, ab, ac};
  if (c > larger(a, b)) normal = {ac, bc, c};
  if (larger(larger(a, b), c) < NEARLY_EQUAL)
    normal = across({x, xy, xz}, {xy, y, yz}, {xz, yz, z});
  else
    normal = unit(normal);
  const double u = normal.x, v = normal.y, w = normal.z;
  const double quotient =
      u * (u * xx + 2 * (v * xy + w * xz)) + v * (v * yy + 2 * w * yz) + w * w * zz;
  const double low = larger(quotient, 0.0), remaining = trace - low;
  const double square = larger(remaining * remaining - 4 * (minors - low * remaining), 0.0);
  const double spread = square_root(square);
  plane.a = u, plane.b = v, plane.c = w;
  plane.low = low * safe, plane.middle = larger((remaining - spread) / 2, 0.0) * safe;
  plane.high = larger((remaining + spread) / 2, 0.0) * safe;
}

// Mean (3) and covariance (6) of a patch with nonnegative weights; returns the weight sum.
INLINE float moments(const Patch& patch, const float* weights, int width, float* mean,
                     float* covariance) {
  Lanes sum{}, sx{}, sy{}, sz{};
  for (int j = 0; j < width; j += LANES) {
    const Lanes weight = load(weights + j);
    sum += weight, sx += weight * load(patch.x + j);
    sy += weight * load(patch.y + j), sz += weight * load(patch.z + j);
  }
  const float count = total(sum), inverse = count > 0 ? 1 / count : 1;
  mean[0] = total(sx) * inverse, mean[1] = total(sy) * inverse, mean[2] = total(sz) * inverse;
  Lanes s[6] = {};
  for (int j = 0; j < width; j += LANES) {
    const Lanes x = load(patch.x + j) - mean[0], y = load(patch.y + j) - mean[1],
                z = load(patch.z + j) - mean[2], scaled = load(weights + j) * inverse;
    const Lanes wx = scaled * x, wy = scaled * y;
    s[0] += wx * x, s[1] += wx * y, s[2] += wx * z;
    s[3] += wy * y, s[4] += wy * z, s[5] += scaled * z * z;
  }
  for (int i = 0; i < 6; i++) covariance[i] = total(s[i]);
  return count;
}

INLINE float farthest(const Patch& patch, const float* weights) {
  Lanes maximum{};
  for (int j = 0; j < patch.width; j += LANES)
    maximum = larger(maximum, patch.sq_lengths(j) * load(weights + j));
  return largest(maximum);
}

// torchrg.normals.consensus.hypotheses.support_scores of a plane in units of the reach.
INLINE float support(const Patch& patch, const float* weights, float a, float b, float c,
                     float offset) {
  Lanes near{}, over{}, under{};
  for (int j = 0; j < patch.width; j += LANES) {
    const Lanes residual = patch.along(a, b, c, j) - offset, weight = load(weights + j);
    near += positive(1 - residual * residual) * weight;
    over += where(residual > 1, weight, all(0)), under += where(residual < -1, weight, all(0));
  }
  return total(near) - smaller(total(over), total(under));
}

// torchrg.linalg.moments.fit_weighted_planes.
INLINE Plane fit_plane(const Patch& patch, const float* weights, int width) {
  Plane plane;
  float mean[3], covariance[6];
  moments(patch, weights, width, mean, covariance);
  decompose(covariance, plane);
  plane.offset = plane.a * mean[0] + plane.b * mean[1] + plane.c * mean[2];
  return plane;
}
