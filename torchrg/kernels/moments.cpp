// Moments and residuals of regions whose points lie side by side: torchrg/linalg/moments.py.
//
// Sums are of halves of halves, in NumPy's order.
#include "plain.h"

namespace {

typedef const double* Doubles;

constexpr int BLOCK = 128;
constexpr int SAMPLE = 256, NEAR = 32;  // of a sample's values, those around the one asked for

// Adds up T terms of places `from` to `from + count`, which `fill` writes.
template <int T, class Fill>
void add_pairwise(int64_t from, int64_t count, const Fill& fill, double (&sums)[T]) {
  if (count > BLOCK) {
    const int64_t half = count / 2 - count / 2 % LANES;
    double others[T];
    add_pairwise<T>(from, half, fill, sums);
    add_pairwise<T>(from + half, count - half, fill, others);
    for (int t = 0; t < T; t++) sums[t] += others[t];
    return;
  }
  alignas(32) double terms[T][BLOCK];
  fill(from, int(count), terms);
  const int whole = int(count) - int(count) % LANES;
  for (int t = 0; t < T; t++) {
    double lanes[LANES] = {}, sum = 0;
    for (int lane = 0; lane < LANES && whole; lane++) lanes[lane] = terms[t][lane];
    for (int j = LANES; j < whole; j += LANES)
      for (int lane = 0; lane < LANES; lane++) lanes[lane] += terms[t][j + lane];
    if (whole)
      sum = ((lanes[0] + lanes[1]) + (lanes[2] + lanes[3])) +
            ((lanes[4] + lanes[5]) + (lanes[6] + lanes[7]));
    for (int j = whole; j < count; j++) sum += terms[t][j];
    sums[t] = sum;
  }
}

// As NumPy's reduceat: the first term, and the sum of all others.
template <int T, class Fill>
void add_up(int64_t from, int64_t count, const Fill& fill, double (&sums)[T]) {
  double first[T][BLOCK];
  fill(from, 1, first);
  add_pairwise<T>(from + 1, count - 1, fill, sums);
  for (int t = 0; t < T; t++) sums[t] = first[t][0] + sums[t];
}

// The value that k others precede; values move.
double select(double* values, int64_t count, int64_t k) {
  int64_t low = 0, high = count - 1;
  while (low < high) {
    const double a = values[low], b = values[low + (high - low) / 2], c = values[high];
    const double pivot = larger(smaller(a, b), smaller(larger(a, b), c));
    int64_t below = low, equal = low;
    for (int64_t i = low; i <= high; i++) {
      const double value = values[i];
      values[i] = values[below], values[below] = value;
      below += value < pivot;
    }
    if (k < below) {
      high = below - 1;
      continue;
    }
    for (int64_t i = low; below == low && i <= high; i++) {
      const double value = values[i];
      values[i] = values[equal], values[equal] = value;
      equal += value == pivot;
    }
    if (k < equal) return pivot;
    low = larger(below, equal);
  }
  return values[k];
}

// The same of many values: those that a sample shows to be near the one are moved to the front. If
// it is none of them `fill` writes all again.
template <class Fill>
double select_filled(double* values, int64_t count, int64_t k, const Fill& fill) {
  if (count < 4 * SAMPLE) return select(values, count, k);
  double sample[SAMPLE];
  for (int64_t i = 0; i < SAMPLE; i++) sample[i] = values[i * count / SAMPLE];
  const int64_t rank = k * SAMPLE / count, low_rank = larger(rank - NEAR, int64_t(0)),
                high_rank = smaller(rank + NEAR, int64_t(SAMPLE - 1));
  const double low = select(sample, SAMPLE, low_rank), high = select(sample, SAMPLE, high_rank);
  int64_t below = 0, between = 0;
  for (int64_t i = 0; i < count; i++) {
    const double value = values[i];
    values[between] = value;
    below += value < low, between += (value >= low) & (value <= high);
  }
  if (k >= below && k < below + between) return select(values, between, k - below);
  fill();
  return select(values, count, k);
}

INLINE int64_t sum_of(Longs counts, int64_t num, int64_t n) {
  int64_t total = 0;
  for (int64_t m = 0; m < num; m++) {
    if (counts[m] < 1 || counts[m] > n - total) return -1;
    total += counts[m];
  }
  return total;
}

}  // namespace

// Segments.rows, counts and sizes: of regions of many points every so many, so that at most `most`
// are taken.
KERNEL segment_rows(int64_t n, int64_t num, Longs labels, int64_t most, int64_t* counts,
                    int64_t* sizes, int64_t* places, int64_t* rows) {
  if (most < 1) return TOO_WIDE;
  int64_t end = 0;
  for (int64_t i = 0; i < n; i++) end = larger(end, labels[i] + 1);
  if (end > num) return NO_SUCH_ROW;
  for (int64_t m = 0; m < num; m++) sizes[m] = counts[m] = 0;
  visit_runs(labels, n, [&](int64_t m, int64_t from, int64_t to) {
    if (m >= 0) sizes[m] += to - from;
  });
  const auto step_of = [&](int64_t m) { return larger((sizes[m] + most - 1) / most, int64_t(1)); };
  for (int64_t m = 0, start = 0; m < num; m++)
    places[m] = start, start += (sizes[m] + step_of(m) - 1) / step_of(m);
  // The count is of points up to the next one that is taken.
  visit_runs(labels, n, [&](int64_t m, int64_t from, int64_t to) {
    if (m < 0) return;
    const int64_t step = step_of(m);
    int64_t next = from + counts[m];
    for (; next < to; next += step) rows[places[m]++] = next;
    counts[m] = next - to;
  });
  for (int64_t m = 0; m < num; m++) counts[m] = places[m] - (m ? places[m - 1] : 0);
  return DONE;
}

// Segments.along: coordinates (A, n) of rows along the axes of their regions, about centers.
KERNEL segment_coordinates(int64_t P, int64_t n, int64_t num, int64_t num_axes, Doubles x,
                           Doubles y, Doubles z, Longs rows, Longs counts, Doubles centers,
                           Doubles axes, double* coordinates) {
  if (sum_of(counts, num, n) < 0) return NO_SUCH_ROW;
  double u[BLOCK], v[BLOCK], w[BLOCK];
  for (int64_t m = 0, start = 0; m < num; start += counts[m++])
    for (int64_t from = start; from < start + counts[m]; from += BLOCK) {
      const int count = int(smaller(start + counts[m] - from, int64_t(BLOCK)));
      const double* center = centers + 3 * m;
      for (int j = 0; j < count; j++) {
        const int64_t row = rows[from + j];
        if (row < 0 || row >= P) return NO_SUCH_ROW;
        u[j] = x[row] - center[0], v[j] = y[row] - center[1], w[j] = z[row] - center[2];
      }
      for (int64_t a = 0; a < num_axes; a++) {
        const double* axis = axes + 3 * (num_axes * m + a);
        for (int j = 0; j < count; j++)
          coordinates[a * n + from + j] = u[j] * axis[0] + v[j] * axis[1] + w[j] * axis[2];
      }
    }
  return DONE;
}

// Segments.moments: means and covariances of weighted points, about zero if not centered.
KERNEL segment_moments(int64_t n, int64_t num, Doubles x, Doubles y, Doubles z, Doubles weights,
                       Longs counts, int64_t is_centered, double* means, double* covariances) {
  if (sum_of(counts, num, n) < 0) return NO_SUCH_ROW;
  int64_t start = 0;
  for (int64_t m = 0; m < num; start += counts[m++]) {
    double sums[4], *mean = means + 3 * m, squares[6];
    add_up<4>(start, counts[m], [&](int64_t from, int count, double (*terms)[BLOCK]) {
      for (int j = 0; j < count; j++) {
        const double weight = weights[from + j];
        terms[0][j] = x[from + j] * weight, terms[1][j] = y[from + j] * weight;
        terms[2][j] = z[from + j] * weight, terms[3][j] = weight;
      }
    }, sums);
    const double total = sums[3];
    for (int axis = 0; axis < 3; axis++) mean[axis] = is_centered ? sums[axis] / total : 0;
    const double a = mean[0], b = mean[1], c = mean[2];
    add_up<6>(start, counts[m], [&](int64_t from, int count, double (*terms)[BLOCK]) {
      for (int j = 0; j < count; j++) {
        const double u = x[from + j] - a, v = y[from + j] - b, w = z[from + j] - c;
        const double weight = weights[from + j], wu = weight * u, wv = weight * v;
        terms[0][j] = wu * u, terms[1][j] = wu * v, terms[2][j] = wu * w;
        terms[3][j] = wv * v, terms[4][j] = wv * w, terms[5][j] = weight * w * w;
      }
    }, squares);
    const int place[9] = {0, 1, 2, 1, 3, 4, 2, 4, 5};
    for (int entry = 0; entry < 9; entry++)
      covariances[9 * m + entry] = squares[place[entry]] / total;
  }
  return DONE;
}

// Segments.reweigh: medians and mean squares of the distances of points from planes, and Tukey's
// bisquare of these in units of `cut` medians, or of the least.
KERNEL reweigh_segments(int64_t n, int64_t num, Doubles x, Doubles y, Doubles z, Longs counts,
                        Doubles means, Doubles axes, Doubles least, double mad, double cut,
                        double* weights, double* medians, double* squares) {
  if (sum_of(counts, num, n) < 0) return NO_SUCH_ROW;
  int64_t start = 0;
  for (int64_t m = 0; m < num; start += counts[m++]) {
    const double a = means[3 * m], b = means[3 * m + 1], c = means[3 * m + 2];
    const double p = axes[3 * m], q = axes[3 * m + 1], r = axes[3 * m + 2];
    const auto residual = [&](int64_t i) { return (x[i] - a) * p + (y[i] - b) * q + (z[i] - c) * r; };
    double sum[1];
    const auto fill = [&]() {
      for (int64_t i = start; i < start + counts[m]; i++) {
        const double away = size_of(residual(i));
        weights[i] = away < double(INFINITE) ? away : double(INFINITE);
      }
    };
    fill();
    add_up<1>(start, counts[m], [&](int64_t from, int count, double (*terms)[BLOCK]) {
      for (int j = 0; j < count; j++) terms[0][j] = weights[from + j] * weights[from + j];
    }, sum);
    medians[m] = select_filled(weights + start, counts[m], (counts[m] - 1) / 2, fill);
    squares[m] = sum[0] / double(counts[m]);
    double unit = cut * larger(mad * medians[m], least[m]);
    unit = unit > 0 ? unit : 1;
    for (int64_t i = start; i < start + counts[m]; i++) {
      const double ratio = residual(i) / unit, weight = larger(1 - ratio * ratio, 0.0);
      weights[i] = weight * weight;
    }
  }
  return DONE;
}

// table._outer_places of each region: whether its points (x, y) are outside of the octagon of the
// farthest ones.
KERNEL outer_places(int64_t n, int64_t num, Doubles x, Doubles y, Longs counts, double rounding,
                    bool* outer) {
  if (sum_of(counts, num, n) < 0) return NO_SUCH_ROW;
  for (int64_t m = 0, start = 0; m < num; start += counts[m++]) {
    const int64_t end = start + counts[m];
    int64_t farthest[8];
    double most[8], largest = 0;
    for (int e = 0; e < 8; e++) farthest[e] = start, most[e] = -double(INFINITE);
    for (int64_t i = start; i < end; i++) {
      const double along[4] = {x[i], x[i] + y[i], y[i], y[i] - x[i]};
      for (int e = 0; e < 4; e++) {
        if (along[e] > most[e]) most[e] = along[e], farthest[e] = i;
        if (-along[e] > most[e + 4]) most[e + 4] = -along[e], farthest[e + 4] = i;
      }
      largest = larger(largest, larger(size_of(x[i]), size_of(y[i])));
    }
    int corners = 0;
    int64_t octagon[8];
    for (int e = 0; e < 8; e++)
      if (farthest[e] != farthest[(e + 7) % 8]) octagon[corners++] = farthest[e];
    double u[8], v[8], offset[8];
    for (int e = 0; e < corners; e++) {
      const int64_t one = octagon[e], next = octagon[(e + 1) % corners];
      u[e] = y[one] - y[next], v[e] = x[next] - x[one];
      offset[e] = u[e] * x[one] + v[e] * y[one] +
                  rounding * larger(size_of(u[e]), size_of(v[e])) * largest;
    }
    for (int64_t i = start; i < end; i++) {
      bool inside = corners > 2;
      for (int e = 0; e < corners; e++) inside &= u[e] * x[i] + v[e] * y[i] > offset[e];
      outer[i] = !inside;
    }
  }
  return DONE;
}
