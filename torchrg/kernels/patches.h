// Eight neighborhoods at a time, one per lane, so that no sum and no choice crosses lanes.
#pragma once
#include "plain.h"

// One number per point of eight neighborhoods, one neighborhood per lane.
struct Column {
  // 17 lines of a cache of 64 sets follow, so that columns do not displace each other.
  alignas(32) float values[MAX_WIDTH * LANES + 17 * 16];

  INLINE_MEMBER Lanes operator[](int j) const { return load(values + j * LANES); }
  INLINE_MEMBER void set(int j, Lanes lanes) { store(values + j * LANES, lanes); }
  INLINE_MEMBER float& at(int j, int lane) { return values[j * LANES + lane]; }
  INLINE_MEMBER float at(int j, int lane) const { return values[j * LANES + lane]; }
  INLINE_MEMBER void set_half(int j, int lane, FourFloats four) {
    __builtin_memcpy(values + j * LANES + lane, &four, sizeof four);
  }
  // Replaces lanes by the same lanes of another column, or by one lane of it.
  INLINE_MEMBER void replace(Flags lanes, const Column& other, int n) {
    for (int k = 0; k < n; k++) set(k, where(lanes, other[k], (*this)[k]));
  }
  INLINE_MEMBER void replace(Flags lanes, const Column& other, int64_t lane, int n) {
    const float* from = other.values + lane;
    for (int k = 0; k < n; k++) set(k, where(lanes, all(from[k * LANES]), (*this)[k]));
  }
};

template <int T>
struct Sums {
  Lanes sums[T];

  INLINE_MEMBER const Lanes& operator[](int t) const { return sums[t]; }
};

// torchrg.linalg.moments.sum_neighbors of T terms: eight partial sums, then sums of these.
template <int T, class Add>
INLINE Sums<T> add_up(int width, const Add& add) {
  Lanes parts[LANES][T];
  for (int first = 0; first < LANES; first++) {
    Lanes part[T] = {};
    for (int j = first; j < width; j += LANES) add(j, part);
    for (int t = 0; t < T; t++) parts[first][t] = part[t];
  }
  Sums<T> found;
  for (int t = 0; t < T; t++)
    found.sums[t] = ((parts[0][t] + parts[4][t]) + (parts[2][t] + parts[6][t])) +
                    ((parts[1][t] + parts[5][t]) + (parts[3][t] + parts[7][t]));
  return found;
}

// One vector per point.
struct VectorColumns {
  Column columns[3];

  INLINE_MEMBER Vectors operator[](int j) const {
    return {columns[0][j], columns[1][j], columns[2][j]};
  }
  INLINE_MEMBER void set(int j, const Vectors& vectors) {
    columns[0].set(j, vectors.x), columns[1].set(j, vectors.y), columns[2].set(j, vectors.z);
  }
};

// The same of one term.
template <class Term>
INLINE Lanes sum_of(int width, const Term& term) {
  return add_up<1>(width, [&](int j, Lanes* sum) { *sum += term(j); })[0];
}

// Eight neighborhoods relative to their first points; weights are 0 or 1.
struct Patch : VectorColumns {
  Column weight;
  int width;
};

// Eight rows of arrays, and the positions of their results.
struct Rows {
  int used;  // lanes; the others repeat a row
  int64_t numbers[LANES], positions[LANES];

  // Takes rows of `numbers`, or the numbers themselves, from `start` on; false if out of range.
  INLINE_MEMBER bool set(Longs rows, int64_t start, int64_t end, int64_t num_rows) {
    used = int(smaller(end - start, int64_t(LANES)));
    bool inside = true;
    for (int lane = 0; lane < LANES; lane++) {
      positions[lane] = start + smaller(lane, used - 1);
      numbers[lane] = rows ? rows[positions[lane]] : positions[lane];
      inside &= numbers[lane] >= 0 && numbers[lane] < num_rows;
    }
    return inside;
  }
  // Adds a row, whose results go to the position of its number; whether all lanes are used.
  INLINE_MEMBER bool add(int64_t number) {
    for (int lane = used; lane < LANES; lane++) numbers[lane] = positions[lane] = number;
    return ++used == LANES;
  }
  // Column `column` of an array of such rows.
  INLINE_MEMBER Lanes of(Floats values, int num_columns = 1, int column = 0) const {
    float lanes[LANES];
    for (int lane = 0; lane < LANES; lane++)
      lanes[lane] = values[num_columns * numbers[lane] + column];
    return load(lanes);
  }
  INLINE_MEMBER Vectors vectors(Floats values, int num_columns = 3, int column = 0) const {
    return {of(values, num_columns, column), of(values, num_columns, column + 1),
            of(values, num_columns, column + 2)};
  }
  // Their neighbors of one rank.
  INLINE_MEMBER Rows neighbors(Ints indices, int64_t k, int64_t rank) const {
    Rows found = *this;
    for (int64_t& number : found.numbers) number = indices[number * k + rank];
    return found;
  }
  INLINE_MEMBER Flags flags(Flagged mask, int64_t k = 1, int64_t column = 0) const {
    float lanes[LANES];
    for (int lane = 0; lane < LANES; lane++) lanes[lane] = mask[numbers[lane] * k + column];
    return load(lanes) > 0;
  }
  INLINE_MEMBER void write(Lanes lanes, float* values, int num_columns = 1, int column = 0) const {
    float found[LANES];
    store(found, lanes);
    for (int lane = 0; lane < used; lane++)
      values[num_columns * positions[lane] + column] = found[lane];
  }
  INLINE_MEMBER void write(Flags flags, bool* values) const {
    for (int lane = 0; lane < used; lane++) values[positions[lane]] = flags[lane];
  }
  INLINE_MEMBER void write(const Vectors& vectors, float* values) const {
    write(vectors.x, values, 3, 0), write(vectors.y, values, 3, 1), write(vectors.z, values, 3, 2);
  }
};

// Points (N, 3), neighbor lists of length k, and an optional mask of counted neighbors.
struct Lists {
  int64_t num_points, num_lists, k;
  const float* points;
  const int32_t* indices;
  const bool* mask;
};

#if defined(__clang__) || __GNUC__ >= 12
#define SHUFFLED(a, b, i, j, k, l) __builtin_shufflevector(a, b, i, j, k, l)
#else
#define SHUFFLED(a, b, i, j, k, l) __builtin_shuffle(a, b, FourFlags{i, j, k, l})
#endif

// Transposes four rows.
INLINE void transpose(FourFloats (&rows)[4]) {
  const FourFloats a = SHUFFLED(rows[0], rows[1], 0, 4, 1, 5),
                   b = SHUFFLED(rows[2], rows[3], 0, 4, 1, 5),
                   c = SHUFFLED(rows[0], rows[1], 2, 6, 3, 7),
                   d = SHUFFLED(rows[2], rows[3], 2, 6, 3, 7);
  rows[0] = SHUFFLED(a, b, 0, 1, 4, 5), rows[1] = SHUFFLED(a, b, 2, 3, 6, 7);
  rows[2] = SHUFFLED(c, d, 0, 1, 4, 5), rows[3] = SHUFFLED(c, d, 2, 3, 6, 7);
}

// Gathers `size` adjacent numbers, 3 or 4, of the neighbors of one rank of four rows.
template <int size>
INLINE void gather_four(Floats values, int num_columns, Ints indices, int64_t k,
                        const int64_t* rows, int64_t rank, FourFloats (&found)[4]) {
  for (int lane = 0; lane < 4; lane++) {
    const float* from = values + num_columns * int64_t(indices[rows[lane] * k + rank]);
    if (size == 4) {
      found[lane] = read_as<FourFloats>(from);
    } else {
      found[lane] = FourFloats(TwoDoubles{read_as<double>(from), 0});
      found[lane][2] = from[2];
    }
  }
  transpose(found);
}

// Gathers the neighbors of lists.
INLINE void gather(const Lists& lists, const Rows& rows, Patch& patch) {
  const int k = patch.width = int(lists.k);
  for (int half = 0; half < LANES; half += 4) {
    FourFloats first[4], found[4];
    for (int j = 0; j < k; j++) {
      gather_four<3>(lists.points, 3, lists.indices, k, rows.numbers + half, j, found);
      for (int axis = 0; axis < 3; axis++) {
        if (j == 0) first[axis] = found[axis];
        patch.columns[axis].set_half(j, half, found[axis] - first[axis]);
      }
      patch.weight.set_half(j, half, FourFloats{} + 1);
    }
  }
  for (int j = 0; lists.mask && j < k; j++) {
    const Flags counts = rows.flags(lists.mask, k, j);
    patch.weight.set(j, one_where(counts));
    patch.set(j, where(counts, patch[j], Vectors{}));
  }
}

// Calls `visit` with all rows or n rows, eight at a time, whose lists have valid indices.
template <class Visit>
INLINE int64_t visit_rows(const Lists& lists, Longs rows, int64_t n, const Visit& visit) {
  if (lists.k < 1 || lists.k > MAX_WIDTH) return TOO_WIDE;
  constexpr int LINE = 16;  // indices in a line of the cache
  Rows eight;
  for (int64_t q = 0; q < n; q += LANES) {
    if (!eight.set(rows, q, n, lists.num_lists)) return NO_SUCH_ROW;
    const Ints next = lists.indices + (eight.numbers[LANES - 1] + 1) * lists.k;
    for (int64_t j = 0; j < LANES * lists.k; j += LINE) __builtin_prefetch(next + j);
    bool inside = true;
    for (int64_t number : eight.numbers)
      inside &= are_rows(lists.indices + number * lists.k, lists.k, lists.num_points);
    if (!inside) return NO_SUCH_ROW;
    visit(eight);
  }
  return DONE;
}
// The same with their patches.
template <class Visit>
INLINE int64_t visit_patches(const Lists& lists, Longs rows, int64_t n, const Visit& visit) {
  Patch patch;
  return visit_rows(lists, rows, n, [&](const Rows& eight) {
    gather(lists, eight, patch);
    visit(eight, patch);
  });
}

// Planes normal . q = offset.
struct Planes {
  Vectors normal;
  Lanes offset{};

  INLINE_MEMBER Lanes residuals(const Patch& patch, int j) const {
    return dot(patch[j], normal) - offset;
  }
  INLINE_MEMBER void write(const Rows& rows, float* normals, float* offsets) const {
    rows.write(normal, normals), rows.write(offset, offsets);
  }
};
INLINE Planes planes_of(const Rows& rows, Floats normals, Floats offsets) {
  return {rows.vectors(normals), rows.of(offsets)};
}
INLINE Planes choose(Flags flags, const Planes& p, const Planes& q) {
  return {where(flags, p.normal, q.normal), where(flags, p.offset, q.offset)};
}

// Least-squares planes, the eigenvalues of their covariances, and their weights.
struct Fits : Planes {
  Lanes low{}, middle{}, high{}, count{};
};

struct Vector {
  double x, y, z;
};

// torchrg.linalg.eigen._orthogonal: a unit vector orthogonal to the direction of a rank-one matrix.
static Vector across(Vector first, Vector second, Vector third) {
  Vector row = second.y > first.x ? second : first;
  if (third.z > larger(first.x, second.y)) row = third;
  const double sizes[3] = {size_of(row.x), size_of(row.y), size_of(row.z)};
  const bool is_z = sizes[2] < smaller(sizes[0], sizes[1]), is_y = !is_z && sizes[1] < sizes[0];
  const double i = !is_y && !is_z, j = is_y, k = is_z;
  const Vector found = {row.y * k - row.z * j, row.z * i - row.x * k, row.x * j - row.y * i};
  const double length = square_root(found.x * found.x + found.y * found.y + found.z * found.z);
  if (!(length > 0)) return {i, j, k};
  return {found.x / length, found.y / length, found.z / length};
}

// The doubles that a register holds.
#ifdef __AVX__
constexpr int WIDE = 4;
#else
constexpr int WIDE = 2;
#endif
typedef double Wide __attribute__((vector_size(8 * WIDE)));
typedef float Narrow __attribute__((vector_size(4 * WIDE)));
typedef int64_t WideFlags __attribute__((vector_size(8 * WIDE)));
INLINE Wide square_root(Wide a) {
  for (int i = 0; i < WIDE; i++) a[i] = square_root(a[i]);
  return a;
}

// torchrg.linalg.smallest_eigenvector3, bit-identical, of some lanes.
struct Eigenvectors {
  Wide xx, xy, xz, yy, yz, zz, safe, trace, minors, determinant, root;
  WideFlags moves;

  INLINE_MEMBER void start(const Wide (&covariances)[6]) {
    Wide scale{};
    for (const Wide& entry : covariances) scale = larger(scale, magnitude(entry));
    safe = where(scale > 0, scale, Wide{} + 1);
    xx = covariances[0] / safe, xy = covariances[1] / safe, xz = covariances[2] / safe;
    yy = covariances[3] / safe, yz = covariances[4] / safe, zz = covariances[5] / safe;
    trace = xx + yy + zz;
    minors = xx * yy - xy * xy + (xx * zz - xz * xz) + (yy * zz - yz * yz);
    determinant = zz * (xx * yy - xy * xy) - yz * (xx * yz - xy * xz) + xz * (xy * yz - yy * xz);
    root = Wide{}, moves = ~WideFlags{};
  }
  // One step of Newton's method towards the smallest root.
  INLINE_MEMBER void step(bool may_stop) {
    constexpr double CONVERGED = 1e-9;
    const Wide value = ((root - trace) * root + minors) * root - determinant;
    const Wide slope = (3 * root - 2 * trace) * root + minors;
    const Wide step = value / slope, size = magnitude(step);
    const WideFlags can_move = moves & (size < double(INFINITE));
    root = where(can_move, root - step, root);
    if (may_stop) moves = can_move & (size > CONVERGED * trace);
  }
  // The vector, and the eigenvalues in ascending order.
  INLINE_MEMBER void finish(Wide (&found)[6]) const {
    constexpr double NEARLY_EQUAL = 1e-9;
    const Wide x = xx - root, y = yy - root, z = zz - root;
    const Wide a = y * z - yz * yz, b = x * z - xz * xz, c = x * y - xy * xy;
    const Wide ab = xz * yz - xy * z, ac = xy * yz - xz * y, bc = xy * xz - x * yz;
    const WideFlags is_second = b > a, is_third = c > larger(a, b);
    Wide u = where(is_third, ac, where(is_second, ab, a));
    Wide v = where(is_third, bc, where(is_second, b, ab));
    Wide w = where(is_third, c, where(is_second, bc, ac));
    const Wide length = square_root(u * u + v * v + w * w);
    u /= length, v /= length, w /= length;
    const WideFlags is_line = larger(larger(a, b), c) < NEARLY_EQUAL;
    for (int i = 0; i < WIDE && is_any(is_line); i++) {
      if (!is_line[i]) continue;
      const Vector normal =
          across({x[i], xy[i], xz[i]}, {xy[i], y[i], yz[i]}, {xz[i], yz[i], z[i]});
      u[i] = normal.x, v[i] = normal.y, w[i] = normal.z;
    }
    const Wide low = larger(
        u * (u * xx + 2 * (v * xy + w * xz)) + v * (v * yy + 2 * w * yz) + w * w * zz, Wide{});
    const Wide remaining = trace - low;
    const Wide spread =
        square_root(larger(remaining * remaining - 4 * (minors - low * remaining), Wide{}));
    found[0] = u, found[1] = v, found[2] = w, found[3] = low * safe;
    found[4] = larger((remaining - spread) / 2, Wide{}) * safe;
    found[5] = larger((remaining + spread) / 2, Wide{}) * safe;
  }
};

// Normals and eigenvalues of covariances xx xy xz yy yz zz.
static Fits decompose(const Sums<6>& covariances) {
  constexpr int FIRST_STEPS = 4, STEPS = 40, PARTS = LANES / WIDE;
  struct Parts {
    Narrow parts[PARTS];
  } columns[6];
  for (int i = 0; i < 6; i++) columns[i] = read_as<Parts>(&covariances[i]);
  Eigenvectors parts[PARTS];
  WideFlags moves = ~WideFlags{};
  Wide wide[6];
  for (int part = 0; part < PARTS; part++) {
    for (int i = 0; i < 6; i++) wide[i] = __builtin_convertvector(columns[i].parts[part], Wide);
    parts[part].start(wide);
  }
  for (int i = 1; i <= STEPS && is_any(moves); i++) {
    moves = WideFlags{};
    for (Eigenvectors& part : parts) part.step(i >= FIRST_STEPS), moves |= part.moves;
  }
  Lanes found[6];
  for (int part = 0; part < PARTS; part++) {
    parts[part].finish(wide);
    for (int i = 0; i < 6; i++) columns[i].parts[part] = __builtin_convertvector(wide[i], Narrow);
  }
  for (int i = 0; i < 6; i++) found[i] = read_as<Lanes>(&columns[i]);
  return {Planes{{found[0], found[1], found[2]}}, found[3], found[4], found[5], Lanes{}};
}

INLINE void add(const Vectors& a, Lanes* sum) { sum[0] += a.x, sum[1] += a.y, sum[2] += a.z; }

// Weight sums, means and covariances of patches with nonnegative weights.
struct Moments {
  Lanes count;
  Vectors mean;
  Sums<6> covariance;
};
INLINE Moments moments(const Patch& patch, const Column& weights, int width) {
  const Sums<4> sums = add_up<4>(width, [&](int j, Lanes* sum) {
    const Lanes weight = weights[j];
    sum[0] += weight, add(weight * patch[j], sum + 1);
  });
  const Lanes inverse = 1 / or_one(sums[0]);
  const Vectors mean = inverse * Vectors{sums[1], sums[2], sums[3]};
  const Sums<6> covariance = add_up<6>(width, [&](int j, Lanes* sum) {
    // By components: the library for any processor runs out of registers for vectors.
    const Lanes x = patch.columns[0][j] - mean.x, y = patch.columns[1][j] - mean.y;
    const Lanes z = patch.columns[2][j] - mean.z;
    const Lanes scaled = weights[j] * inverse, wx = scaled * x, wy = scaled * y;
    sum[0] += wx * x, sum[1] += wx * y, sum[2] += wx * z;
    sum[3] += wy * y, sum[4] += wy * z, sum[5] += scaled * z * z;
  });
  return {sums[0], mean, covariance};
}

// The sum of 0 and 1, in any order.
INLINE Lanes sum(const Column& values, int width) {
  Lanes sums{};
  for (int j = 0; j < width; j++) sums += values[j];
  return sums;
}

INLINE Lanes farthest(const Patch& patch, const Column& weights) {
  Lanes maximum{};
  for (int j = 0; j < patch.width; j++)
    maximum = larger(maximum, dot(patch[j], patch[j]) * weights[j]);
  return maximum;
}

// torchrg.normals.consensus.hypotheses.support_scores of planes in units of the reach.
INLINE Lanes support(const Patch& patch, const Column& weights, const Planes& planes) {
  const Sums<3> sums = add_up<3>(patch.width, [&](int j, Lanes* sum) {
    const Lanes residual = planes.residuals(patch, j), weight = weights[j];
    sum[0] += positive(1 - residual * residual) * weight;
    sum[1] += where(residual > 1, weight, all(0));
    sum[2] += where(residual < -1, weight, all(0));
  });
  return sums[0] - smaller(sums[1], sums[2]);
}

// torchrg.linalg.moments.fit_weighted_planes.
INLINE Fits fit_planes(const Patch& patch, const Column& weights, int width) {
  const Moments found = moments(patch, weights, width);
  Fits fits = decompose(found.covariance);
  fits.offset = dot(fits.normal, found.mean), fits.count = found.count;
  return fits;
}
