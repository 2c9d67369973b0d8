// Robust fits of many patches, one patch per lane, bit-identical to torchrg/robust.
//
// Sums run over the points in order. Columns (K, M) hold point k of patch m at k * M + m.
#include "patches.h"

// A loop that needs the registers for itself.
#define SEPARATE __attribute__((noinline))

namespace {

constexpr float TYPICAL = 0.42f;       // Qn's difference / length of the shortest half
constexpr float MIN_MARGIN = 8;        // differences on each side of a window, and as a fraction of
constexpr float MARGIN = 0.6f;         // the number by which the nearest limit misses the rank
constexpr int MAX_DIFFERENCES = 2048;  // in a window
constexpr int NUM_WINDOWS = 4;         // windows before all differences between limits are searched
constexpr int MAX_ROUNDS = NUM_WINDOWS + 4, MAX_TURNS = 1000;  // of rows that are not sorted
constexpr int FREE_TURNS = 4;  // turns in a window after which every second one bisects

struct Points {
  Column columns[3];
};

// Patches m to m + 7 of a row; the last patch fills up lanes beyond the end.
INLINE Lanes load_row(const float* row, int64_t m, int64_t num_patches) {
  if (m + LANES <= num_patches) return load(row + m);
  float lanes[LANES];
  for (int64_t l = 0; l < LANES; l++) lanes[l] = row[smaller(m + l, num_patches - 1)];
  return load(lanes);
}
INLINE void store_row(float* row, int64_t m, int64_t num_patches, Lanes lanes) {
  if (m + LANES <= num_patches) return store(row + m, lanes);
  for (int l = 0; m + l < num_patches; l++) row[m + l] = lanes[l];
}
INLINE void load_column(const float* values, int n, int64_t m, int64_t M, Column& column,
                        int64_t num_starts = 1) {
  for (int k = 0; k < n; k++) column.set(k, load_row(values + k * num_starts * M, m, M));
}
INLINE void load_points(Floats x, Floats y, Floats z, int n, int64_t m, int64_t M, Points& points) {
  load_column(x, n, m, M, points.columns[0]);
  load_column(y, n, m, M, points.columns[1]);
  load_column(z, n, m, M, points.columns[2]);
}

// Sorts each lane into rows, which may be the values: merge exchange (Knuth 5.2.2, algorithm M).
void sort_lanes(const Column& values, int n, Column& rows) {
  for (int k = 0; k < n; k++) rows.set(k, values[k]);
  int top = 1;
  while (2 * top < n) top *= 2;
  for (int p = top; p > 0; p /= 2)
    for (int q = top, r = 0, d = p;; d = q - p, q /= 2, r = p) {
      const auto exchange = [&](int i) {
        const Lanes a = rows[i], b = rows[i + d];
        rows.set(i, smaller(a, b)), rows.set(i + d, larger(a, b));
      };
      if (p == 1)
        for (int i = r; i < n - d; i += 2) exchange(i);
      for (int from = r; p > 1 && from < n - d; from += 2 * p)
        for (int i = from; i < smaller(from + p, n - d); i++) exchange(i);
      if (q == p) break;
    }
}

INLINE Lanes median_of_sorted(const Column& rows, int n) {
  const Lanes low = rows[(n - 1) / 2], high = rows[n / 2];
  return n % 2 ? low : low + (high - low) / all(2);
}

// Limits of a value: `few` values, too few, are at most `low`, and `many` at most `high`.
struct Bracket {
  Lanes wanted, low, high, few, many;

  INLINE_MEMBER void narrow(Lanes limit, Lanes count) {
    const Flags is_few = count < wanted;
    const Flags moves_low = is_few & (limit > low), moves_high = ~is_few & (limit < high);
    low = where(moves_low, limit, low), few = where(moves_low, count, few);
    high = where(moves_high, limit, high), many = where(moves_high, count, many);
  }
  INLINE_MEMBER Lanes step() const { return (high - low) / (many - few); }  // between differences
};

// Calls `visit` with the differences of sorted rows lag by lag, until one has no difference within
// some limit, where `visit` returns true: larger lags have none either.
template <class Visit>
INLINE void visit_differences(const Column& rows, int n, const Visit& visit) {
  for (int lag = 1; lag <= n / 2; lag++) {
    Flags is_within{};
    for (int i = 0; i < n - lag; i++) is_within = is_within | visit(rows[i + lag] - rows[i]);
    if (!is_any(is_within)) break;
  }
}

// The number of differences up to a pivot.
SEPARATE Lanes count_differences(const Column& rows, int n, Lanes pivot) {
  Flags count{};
  visit_differences(rows, n, [&](Lanes difference) {
    const Flags is_within = difference <= pivot;
    count -= is_within;
    return is_within;
  });
  return to_float(count);
}

struct Around {
  Flags count{};                              // differences at most a pivot
  Lanes below{}, above = Lanes{} + INFINITE;  // the largest of them, and the smallest above

  INLINE_MEMBER Flags add(Lanes difference, Lanes pivot) {
    const Flags is_within = difference <= pivot;
    count -= is_within;
    below = larger(below, where(is_within, difference, all(0)));
    above = smaller(above, where(is_within, all(INFINITE), difference));
    return is_within;
  }
};

// The differences of sorted rows in a window (first, last] of their lane, infinite outside.
struct Window {
  Flags below, within;  // number of differences up to its limits
  int size;             // -1 if there are too many
  alignas(32) float values[(MAX_DIFFERENCES + 1) * LANES];

  SEPARATE void collect(const Column& rows, int n, Lanes first, Lanes last) {
    Flags up_to_first{}, up_to_last{};
    unsigned found = 0;
    visit_differences(rows, n, [&](Lanes difference) {
      const Flags is_below = difference <= first, is_within = difference <= last;
      const Flags is_inside = is_within & ~is_below;
      up_to_first -= is_below, up_to_last -= is_within;
      store(values + found % MAX_DIFFERENCES * LANES, where(is_inside, difference, all(INFINITE)));
      found += is_any(is_inside);
      return is_within;
    });
    below = up_to_first, within = up_to_last, size = found < MAX_DIFFERENCES ? int(found) : -1;
    store(values + found % MAX_DIFFERENCES * LANES, all(INFINITE));
  }

  SEPARATE Around look_around(const Column& rows, int n, Lanes pivot) const {
    Around around, other;
    if (size < 0)
      visit_differences(rows, n, [&](Lanes difference) { return around.add(difference, pivot); });
    else
      around.count = below;
    for (int i = 0; i < size; i += 2) {
      around.add(load(values + i * LANES), pivot);
      other.add(load(values + (i + 1) * LANES), pivot);
    }
    around.count += other.count, around.below = larger(around.below, other.below);
    around.above = smaller(around.above, other.above);
    return around;
  }
};

// The C(h, 2)-th smallest difference of each lane of sorted rows; NaN if one may be infinite, or if
// the rows are not sorted.
//
// Counting the differences up to a typical one leads to a window around the result, and the
// density in a window that misses it to the next one. Regula falsi searches the few differences
// in a window. Where windows miss, such as between ties, all differences between the limits are
// searched, or looked at until those left fit in a window.
SEPARATE Lanes majority_difference(const Column& rows, int n) {
  Window window;
  const int lags = n / 2, rank = lags * (lags + 1) / 2;
  const Lanes wanted = all(rank - 0.5f), spread = rows[n - 1] - rows[0];
  Lanes shortest = spread;
  for (int i = 0; i + lags < n; i++) shortest = smaller(shortest, rows[i + lags] - rows[i]);
  Flags ties{};
  for (int i = 0; i + 1 < n; i++) ties -= rows[i + 1] - rows[i] <= 0;
  const Flags may_be_zero = ties >= Flags{} + lags;
  const Lanes pivot = where(may_be_zero, all(0), shortest * TYPICAL);
  Bracket bracket{wanted, where(may_be_zero, all(-1), all(0)), shortest, Lanes{}, wanted / TYPICAL};
  bracket.narrow(pivot, count_differences(rows, n, pivot));
  Lanes result = where(spread < INFINITE, Lanes{}, all(__builtin_nanf("")));
  Flags open = (shortest > 0) & (spread < INFINITE);
  Lanes step = bracket.step();
  for (int round = 0; is_any(open) && round < MAX_ROUNDS; round++) {
    const Lanes missing = wanted - bracket.few, excess = bracket.many - wanted;
    const Lanes off = smaller(missing, excess);
    const Lanes margin = smaller(off * MARGIN + all(MIN_MARGIN), all(MAX_DIFFERENCES / 16));
    const Lanes up = bracket.low + step * missing, down = bracket.high - step * excess;
    Lanes first = bracket.low, last = bracket.high;
    const Lanes guess = larger(smaller(where(missing < excess, up, down), last), first);
    if (round < NUM_WINDOWS) first = larger(first, guess - step * margin);
    if (round < NUM_WINDOWS) last = smaller(last, guess + step * margin);
    window.collect(rows, n, where(open, first, last), last);
    const Lanes below = to_float(window.below), within = to_float(window.within);
    bracket.narrow(first, below), bracket.narrow(last, within);
    step = where(within > below, (last - first) / (within - below), bracket.step());
    if (is_any(open & (within <= below))) round = larger(round, NUM_WINDOWS);
    Flags searched = open & (below < wanted) & (within > wanted);
    Bracket inside = bracket;
    Lanes minimum = inside.low;
    for (int turn = 0; is_any(searched) && turn < MAX_TURNS; turn++) {
      const Lanes number = inside.many - inside.few, part = (wanted - inside.few) / number;
      const bool has_window = window.size >= 0, bisects = turn % 2;
      if (!has_window && !is_any(searched & (number >= MAX_DIFFERENCES / LANES))) break;
      const Lanes fraction = bisects && !(has_window && turn < FREE_TURNS) ? all(0.5f) : part;
      Lanes next = larger(inside.low + (inside.high - inside.low) * fraction, minimum);
      next = where(next < inside.high, next, inside.low);
      const Around around = window.look_around(rows, n, next);
      const Lanes found = to_float(around.count);
      const Flags is_few = found < wanted, is_next = magnitude(found - wanted) < 1;
      const Flags done = searched & (is_next | (is_few & (around.above >= inside.high)));
      result = where(done, where(is_few, around.above, around.below), result);
      open = open & ~done, searched = searched & ~done;
      inside.narrow(where(is_few, next, around.below), found);
      minimum = where(is_few, around.above, minimum);
    }
    if (window.size < 0) bracket = inside;
  }
  result = where(open, all(__builtin_nanf("")), result);
  return result + all(0);
}

Lanes sort_and_scale(const Column& values, int n, double factor, Column& rows) {
  sort_lanes(values, n, rows);
  return majority_difference(rows, n) * float(factor);
}

// lanes.smallest_points.
void mark_smallest(const Column& values, int n, int size, Column& marks) {
  sort_lanes(values, n, marks);
  const Lanes bound = marks[size - 1];
  Lanes room = all(size);
  for (int k = 0; k < n; k++) room -= one_where(values[k] < bound);
  for (int k = 0; k < n; k++) {
    const Flags is_below = values[k] < bound;
    const Lanes is_tied = one_where(~is_below & (values[k] <= bound) & (room > 0));
    marks.set(k, one_where(is_below) + is_tied), room -= is_tied;
  }
}

// A symmetric matrix: xx xy xz yy yz zz.
struct Matrix {
  Lanes entries[6];

  INLINE_MEMBER Lanes& operator()(int i, int j) {
    return entries[i <= j ? i * (5 - i) / 2 + j : j * (5 - j) / 2 + i];
  }
};

// Weighted second moments about the mean or zero.
SEPARATE Matrix find_moments(const Points& points, const Column& weights, int n,
                             bool is_centered) {
  Matrix found;
  Lanes center[3], count{};
  for (int k = 0; k < n; k++) count += weights[k];
  for (int i = 0; i < 3; i++) {
    Lanes sum{};
    for (int k = 0; k < n; k++) sum += weights[k] * points.columns[i][k];
    center[i] = is_centered ? sum / count : Lanes{};
  }
  for (int i = 0; i < 3; i++)
    for (int j = i; j < 3; j++) {
      const Column &a = points.columns[i], &b = points.columns[j];
      Lanes sum{};
      for (int k = 0; k < n; k++) sum += weights[k] * (a[k] - center[i]) * (b[k] - center[j]);
      found(i, j) = sum;
    }
  return found;
}

// starts._correlation.
INLINE void correlate(Matrix& matrix) {
  Lanes spread[3];
  for (int i = 0; i < 3; i++) {
    const Lanes root = roots_of(matrix(i, i));
    spread[i] = where(root > 0, root, all(1));
  }
  for (int i = 0; i < 3; i++)
    for (int j = i; j < 3; j++)
      matrix(i, j) = i == j ? all(1) : matrix(i, j) / (spread[i] * spread[j]);
}

// eigen.eigh3: unit eigenvectors as columns by ascending eigenvalue; false where one is infinite.
SEPARATE Flags decompose(Matrix& matrix, Lanes (&vectors)[3][3]) {
  constexpr int SWEEPS = 5;
  Lanes scale{}, zero{};
  for (const Lanes entry : matrix.entries)
    scale = larger(scale, magnitude(entry)), zero += entry * all(0);
  for (Lanes& entry : matrix.entries) entry = entry / where(scale > 0, scale, all(1));
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) vectors[i][j] = all(i == j);
  for (int turn = 0; turn < 3 * SWEEPS; turn++) {
    const int p = turn % 3 == 2, q = turn % 3 ? 2 : 1, r = 3 - p - q;
    const Lanes between = matrix(p, q), low = matrix(r, p), high = matrix(r, q);
    const Flags is_zero = (between <= 0) & (between >= 0);
    const Lanes tau = (matrix(q, q) - matrix(p, p)) / (where(is_zero, all(1), between) * 2);
    const Lanes sign = where(tau >= 0, all(1), all(-1));
    const Lanes tangent = sign / (magnitude(tau) + roots_of(tau * tau + all(1)));
    const Lanes t = where(is_zero, Lanes{}, tangent);
    const Lanes cosine = all(1) / roots_of(t * t + all(1)), sine = t * cosine;
    matrix(p, p) = matrix(p, p) - t * between, matrix(q, q) = matrix(q, q) + t * between;
    matrix(r, p) = cosine * low - sine * high, matrix(r, q) = sine * low + cosine * high;
    matrix(p, q) = Lanes{};
    for (Lanes(&row)[3] : vectors) {
      const Lanes first = row[p], second = row[q];
      row[p] = cosine * first - sine * second, row[q] = sine * first + cosine * second;
    }
  }
  for (int turn = 0; turn < 3; turn++) {
    const int low = turn % 2, high = low + 1;
    const Flags swaps = matrix(high, high) < matrix(low, low);
    const auto order = [&](Lanes& a, Lanes& b) {
      const Lanes first = a;
      a = where(swaps, b, a), b = where(swaps, first, b);
    };
    order(matrix(low, low), matrix(high, high));
    for (Lanes(&row)[3] : vectors) order(row[low], row[high]);
  }
  return zero <= 0;
}

// starts._double_ranks of each lane.
void rank_points(const Column& values, int n, Column& ranks) {
  for (int i = 0; i < n; i++) {
    Flags rank = Flags{} + 1;
    for (int k = 0; k < n; k++) rank -= (values[k] < values[i]) + (values[k] <= values[i]);
    ranks.set(i, to_float(rank));
  }
}

// lanes.fit_ellipsoid and lanes.sq_distances of weighted points.
INLINE void fit_lanes(const Points& points, const Column& weights, int n, Lanes size, Lanes floor,
                      Points& residuals, Column& distances, Lanes (&squares)[3]) {
  const Column &x = points.columns[0], &y = points.columns[1], &z = points.columns[2];
  Column &u = residuals.columns[0], &v = residuals.columns[1], &w = residuals.columns[2];
  Lanes a{}, b{}, c{}, xx{}, xy{}, xz{}, yy{}, yz{}, zz{};
  for (int k = 0; k < n; k++) {
    const Lanes weight = weights[k];
    a += weight * x[k], b += weight * y[k], c += weight * z[k];
  }
  a = a / size, b = b / size, c = c / size;
  const Lanes minimum = floor * size;
  for (int k = 0; k < n; k++) {
    const Lanes first = x[k] - a, second = y[k] - b, third = z[k] - c, scaled = weights[k] * first;
    u.set(k, first), v.set(k, second), w.set(k, third);
    xx += scaled * first, xy += scaled * second, xz += scaled * third;
  }
  squares[0] = larger(xx, minimum);
  const Lanes p = xy / squares[0], q = xz / squares[0];
  for (int k = 0; k < n; k++) {
    const Lanes second = v[k] - p * u[k], third = w[k] - q * u[k], scaled = weights[k] * second;
    v.set(k, second), w.set(k, third);
    yy += scaled * second, yz += scaled * third;
  }
  squares[1] = larger(yy, minimum);
  const Lanes r = yz / squares[1];
  for (int k = 0; k < n; k++) {
    const Lanes third = w[k] - r * v[k];
    w.set(k, third);
    zz += weights[k] * third * third;
  }
  squares[2] = larger(zz, minimum);
  const Lanes less = size - all(1);
  const Lanes f = all(1) / squares[0] * less, g = all(1) / squares[1] * less,
              h = all(1) / squares[2] * less;
  for (int k = 0; k < n; k++) distances.set(k, u[k] * u[k] * f + v[k] * v[k] * g + w[k] * w[k] * h);
}

struct Job {
  int64_t patch;  // -1 for none
  int64_t start, step;
  double previous;
};

}  // namespace

// torchrg.robust.scale._majority_difference of the first `counts` values of sorted rows; NaN where
// a difference is not finite. Eight rows with equal counts share the lanes.
KERNEL majority_differences(int64_t num_rows, int64_t n, Floats rows, Longs counts, float* found) {
  if (n < 1 || n > MAX_WIDTH) return TOO_WIDE;
  Column lanes;
  int64_t chosen[LANES], low = n, high = 0;
  for (int64_t i = 0; i < num_rows; i++)
    found[i] = 0, low = smaller(low, counts[i]), high = larger(high, counts[i]);
  for (int64_t count = larger(low, int64_t(2)); count <= smaller(high, n); count++) {
    int used = 0;
    for (int64_t i = 0; i < num_rows; i++) {
      if (counts[i] == count) chosen[used++] = i;
      if (used == 0 || (used < LANES && i + 1 < num_rows)) continue;
      for (int l = 0; l < LANES; l++)
        for (int k = 0; k < count; k++) lanes.at(k, l) = rows[chosen[l < used ? l : 0] * n + k];
      const Lanes differences = majority_difference(lanes, int(count));
      for (int l = 0; l < used; l++) found[chosen[l]] = differences[l];
      used = 0;
    }
  }
  return DONE;
}

// exact.find_flats: whether a simplex may lie on a flat. Limits are twice the definition's limits,
// whose roots round differently.
KERNEL may_have_flats(int64_t n, int64_t M, int64_t S, Floats x, Floats y, Floats z, Longs vertices,
                      Floats tolerance, bool* found) {
  constexpr float MIN_EDGE = 0.009f;
  if (n < 1 || n > MAX_WIDTH) return TOO_WIDE;
  for (int64_t i = 0; i < 4 * S; i++)
    if (vertices[i] < 0 || vertices[i] >= n) return NO_SUCH_ROW;
  Points points;
  for (int64_t m = 0; m < M; m += LANES) {
    load_points(x, y, z, int(n), m, M, points);
    const Lanes limit = load_row(tolerance, m, M) * all(4);
    Lanes extent{};
    for (const Column& column : points.columns)
      for (int k = 0; k < n; k++) extent = larger(extent, magnitude(column[k]));
    Flags near{};
    for (int64_t s = 0; s < S; s++) {
      Lanes axes[3][3], reach = limit;
      Flags steep = ~Flags{};
      for (int edge = 0; edge < 3; edge++) {
        Lanes(&across)[3] = axes[edge];
        for (int i = 0; i < 3; i++)
          across[i] = points.columns[i][int(vertices[(edge + 1) * S + s])] -
                      points.columns[i][int(vertices[s])];
        for (int a = 0; a < edge; a++) {
          const Lanes along =
              across[0] * axes[a][0] + across[1] * axes[a][1] + across[2] * axes[a][2];
          for (int i = 0; i < 3; i++) across[i] = across[i] - along * axes[a][i];
        }
        const Lanes height =
            roots_of(across[0] * across[0] + across[1] * across[1] + across[2] * across[2]);
        near += steep & (height <= reach);
        steep = steep & (height > extent * all(MIN_EDGE));
        reach = larger(reach, limit * (all(1) + extent * all(2) / height));
        for (Lanes& component : across) component = component / height;
      }
    }
    for (int64_t l = 0; l < LANES && m + l < M; l++) found[m + l] = near[int(l)] != 0;
  }
  return DONE;
}

// starts._centers_and_scales: median and majority difference of each column.
KERNEL lane_scales(int64_t n, int64_t M, Floats values, float* medians, float* differences) {
  if (n < 2 || n > MAX_WIDTH) return TOO_WIDE;
  Column rows;
  for (int64_t m = 0; m < M; m += LANES) {
    load_column(values, int(n), m, M, rows);
    sort_lanes(rows, int(n), rows);
    store_row(medians, m, M, median_of_sorted(rows, int(n)));
    store_row(differences, m, M, majority_difference(rows, int(n)));
  }
  return DONE;
}

// lanes.smallest_points.
KERNEL smallest_points(int64_t n, int64_t M, Floats values, int64_t size, float* marks) {
  if (n < 1 || n > MAX_WIDTH || size < 1 || size > n) return TOO_WIDE;
  Column column, found;
  for (int64_t m = 0; m < M; m += LANES) {
    load_column(values, int(n), m, M, column);
    mark_smallest(column, int(n), int(size), found);
    for (int k = 0; k < n; k++) store_row(marks + k * M, m, M, found[k]);
  }
  return DONE;
}

// starts._sphered_sets: the six deterministic starts, and where the definition must find them,
// since a scale is zero or a number infinite.
KERNEL deterministic_sets(int64_t num_points, int64_t M, int64_t T, Floats x, Floats y, Floats z,
                          Floats tx, Floats ty, Floats tz, Floats scores, double factor,
                          int64_t size, float* sets, bool* undefined) {
  constexpr int STARTS = 6;
  constexpr float MIN_LENGTH = 0x1p-23f;  // the machine epsilon
  if (num_points < 2 || num_points > MAX_WIDTH || size < 1 || size > num_points) return TOO_WIDE;
  if (T <= 2 * num_points) return TOO_WIDE;
  const int n = int(num_points);
  Points points, moved;
  Column ones, rows, norms;
  for (int k = 0; k < n; k++) ones.set(k, all(1));
  for (int64_t m = 0; m < M; m += LANES) {
    Matrix scatters[STARTS];
    load_points(x, y, z, n, m, M, points), load_points(tx, ty, tz, n, m, M, moved);
    scatters[0] = find_moments(moved, ones, n, true);
    for (int i = 0; i < 3; i++) rank_points(points.columns[i], n, moved.columns[i]);
    scatters[1] = find_moments(moved, ones, n, true);
    for (Column& column : moved.columns)
      for (int k = 0; k < n * LANES; k++) column.values[k] = scores[int(column.values[k])];
    scatters[2] = find_moments(moved, ones, n, true);
    for (int k = 0; k < n; k++) {
      const Lanes u = points.columns[0][k], v = points.columns[1][k], w = points.columns[2][k];
      const Lanes square = u * u + v * v + w * w, root = roots_of(square);
      const Lanes length = where(root > MIN_LENGTH, root, all(1));
      moved.columns[0].set(k, u / length), moved.columns[1].set(k, v / length);
      moved.columns[2].set(k, w / length), norms.set(k, square);
    }
    scatters[3] = find_moments(moved, ones, n, false);
    mark_smallest(norms, n, (n + 1) / 2, rows);
    scatters[4] = find_moments(points, rows, n, true);
    for (int i = 0; i < 3; i++)
      for (int j = i; j < 3; j++) {
        const Column &a = points.columns[i], &b = points.columns[j];
        for (int k = 0; k < n; k++) rows.set(k, a[k] + b[k]);
        const Lanes sum = i == j ? all(2) : sort_and_scale(rows, n, factor, rows);
        for (int k = 0; k < n; k++) rows.set(k, a[k] - b[k]);
        const Lanes difference = i == j ? Lanes{} : sort_and_scale(rows, n, factor, rows);
        scatters[5](i, j) = (sum * sum - difference * difference) / all(4);
      }
    Flags fails{};
    for (int start = 0; start < STARTS; start++) {
      Lanes axes[3][3];
      if (start < 3) correlate(scatters[start]);
      fails = fails | ~decompose(scatters[start], axes);
      for (int d = 0; d < 3; d++) {
        for (int k = 0; k < n; k++)
          norms.set(k, points.columns[0][k] * axes[0][d] + points.columns[1][k] * axes[1][d] +
                           points.columns[2][k] * axes[2][d]);
        const Lanes scale = sort_and_scale(norms, n, factor, rows);
        fails = fails | ~(scale > 0);
        for (int k = 0; k < n; k++) {
          const Lanes value = norms[k] / scale;
          for (int i = 0; i < 3; i++) {
            const Lanes part = value * axes[i][d];
            moved.columns[i].set(k, d ? moved.columns[i][k] + part : part);
          }
        }
      }
      for (int i = 0; i < 3; i++) {
        const Column& column = moved.columns[i];
        sort_lanes(column, n, rows);
        const Lanes center = median_of_sorted(rows, n);
        for (int k = 0; k < n; k++) {
          const Lanes away = column[k] - center;
          norms.set(k, i ? norms[k] + away * away : away * away);
        }
      }
      mark_smallest(norms, n, int(size), rows);
      for (int k = 0; k < n; k++) store_row(sets + (k * STARTS + start) * M, m, M, rows[k]);
    }
    for (int64_t l = 0; l < LANES && m + l < M; l++) undefined[m + l] = fails[int(l)] != 0;
  }
  return DONE;
}

// mcd._concentrate. A start that converges makes room in its lane for the next one.
KERNEL concentrate(int64_t n, int64_t M, int64_t S, Floats x, Floats y, Floats z, Floats initial,
                   Floats floor, int64_t initial_size, int64_t size, int64_t max_steps,
                   float* final, double* best) {
  if (n < 1 || n > MAX_WIDTH || size < 1 || size > n) return TOO_WIDE;
  Points points, residuals, around;
  Column members, distances, marks, starts;
  Job jobs[LANES];
  float floors[LANES] = {}, sizes[LANES] = {};
  // Eight patches start together, as neighbors in memory.
  const int64_t count = (M + LANES - 1) / LANES * LANES * S;
  int64_t next = 0;
  int active = 0;
  const auto enter = [&](int l) {
    while (next < count && next / LANES / S * LANES + next % LANES >= M) next++;
    Job& job = jobs[l] = {-1, next / LANES % larger(S, int64_t(1)), -1, INFINITE};
    if (next >= count) return;
    const int64_t first = next / LANES / S * LANES, lane = next++ % LANES;
    if (lane == 0) {
      if (job.start == 0) load_points(x, y, z, int(n), first, M, around);
      load_column(initial + job.start * M, int(n), first, M, starts, S);
    }
    job.patch = first + lane, active++;
    floors[l] = floor[job.patch], sizes[l] = float(initial_size);
    int32_t flags[LANES] = {};
    flags[l] = -1;
    for (int i = 0; i < 3; i++)
      points.columns[i].replace(load(flags), around.columns[i], lane, int(n));
    members.replace(load(flags), starts, lane, int(n));
  };
  for (int l = 0; l < LANES; l++) enter(l);
  while (active > 0) {
    Lanes squares[3], common{};
    int32_t moved[LANES] = {};
    fit_lanes(points, members, int(n), load(sizes), load(floors), residuals, distances, squares);
    mark_smallest(distances, int(n), int(size), marks);
    for (int k = 0; k < n; k++) common += marks[k] * members[k];
    for (int l = 0; l < LANES; l++) {
      Job& job = jobs[l];
      if (job.patch < 0) continue;
      const double denominator = double(sizes[l] - 1);
      double value = 1;
      for (const Lanes& square : squares) value = value * (double(square[l]) / denominator);
      const bool moves = common[l] < float(size) && value < job.previous && job.step < max_steps;
      if (job.step < 0 || moves) {
        // The first step leads from the initial set to one of the full size.
        if (job.step++ >= 0) job.previous = value;
        sizes[l] = float(size), moved[l] = -1;
        continue;
      }
      for (int k = 0; k < n; k++) final[(k * S + job.start) * M + job.patch] = members.at(k, l);
      best[job.start * M + job.patch] = value;
      active--, enter(l);
    }
    members.replace(load(moved), marks, int(n));
  }
  return DONE;
}

// edges.are_coplanar; rows with a difference that is not finite remain open.
KERNEL are_coplanar(int64_t num_points, int64_t num_rows, int64_t k, Floats points, Floats normals,
                    Ints indices, Flagged tested, double factor, double floor_fraction,
                    bool* passed, bool* open) {
  if (k < 1 || k > MAX_WIDTH) return TOO_WIDE;
  Column residuals, sorted;
  int64_t rows[LANES];
  int used = 0;
  for (int64_t q = 0; q < num_rows; q++) {
    bool is_tested = open[q] = false;
    for (int64_t e = q * k; e < (q + 1) * k; e++) is_tested |= tested[e], passed[e] = !tested[e];
    if (is_tested) rows[used++] = q;
    if (used == 0 || (used < LANES && q + 1 < num_rows)) continue;
    float squares[LANES];
    for (int l = 0; l < LANES; l++) {
      const int32_t* list = indices + k * rows[l < used ? l : 0];
      if (!are_rows(list, k, num_points)) return NO_SUCH_ROW;
      float center[3], normal[3], square = 0;
      for (int i = 0; i < 3; i++)
        center[i] = points[i * num_points + *list], normal[i] = normals[i * num_points + *list];
      for (int j = 0; j < k; j++) {
        const float x = points[list[j]] - center[0], y = points[num_points + list[j]] - center[1],
                    z = points[2 * num_points + list[j]] - center[2];
        residuals.at(j, l) = size_of(x * normal[0] + y * normal[1] + z * normal[2]);
        square = larger(square, x * x + y * y + z * z);
      }
      squares[l] = square;
    }
    const Lanes sq_radius = load(squares);
    Flags is_finite = sq_radius < all(INFINITE);
    for (int j = 0; j < k; j++) is_finite = is_finite & (residuals[j] < all(INFINITE));
    const Lanes floor = all(float(floor_fraction)) * roots_of(sq_radius);
    const Lanes scale = sort_and_scale(residuals, int(k), factor, sorted);
    const Lanes limit = median_of_sorted(sorted, int(k)) + all(2) * larger(scale, floor);
    for (int l = 0; l < used; l++) {
      open[rows[l]] = !is_finite[l];
      for (int j = 0; j < k; j++) passed[k * rows[l] + j] |= residuals.at(j, l) <= limit[l];
    }
    used = 0;
  }
  return DONE;
}
