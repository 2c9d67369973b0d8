// Moments and residuals of regions whose points are contiguous: torchrg/linalg/moments.py.
//
// Pairwise summation in NumPy's order.
#include "plain.h"

namespace {

constexpr int BLOCK = 128;
constexpr int AHEAD = 64;  // pixels that are loaded early

// Sums the T terms of `count` points from index `from` on; `term` writes the terms of one point.
template <int T, class Term>
void add_pairwise(double (&sums)[T], int64_t from, int64_t count, const Term& term) {
  if (count > BLOCK) {
    const int64_t half = count / 2 - count / 2 % LANES;
    double others[T];
    add_pairwise(sums, from, half, term);
    add_pairwise(others, from + half, count - half, term);
    for (int t = 0; t < T; t++) sums[t] += others[t];
    return;
  }
  alignas(32) double terms[T][BLOCK], values[T];
  for (int j = 0; j < count; j++) {
    term(from + j, values);
    for (int t = 0; t < T; t++) terms[t][j] = values[t];
  }
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

// Like NumPy's reduceat: the first term plus the sum of the remaining terms.
template <int T, class Term>
void add_up(double (&sums)[T], int64_t from, int64_t count, const Term& term) {
  double first[T];
  term(from, first);
  add_pairwise(sums, from + 1, count - 1, term);
  for (int t = 0; t < T; t++) sums[t] = first[t] + sums[t];
}

// Moves the values of [low, high] that belong to the front, without branches; returns their end.
template <class Belongs>
INLINE int64_t move_down(double* values, int64_t low, int64_t high, const Belongs& belongs) {
  int64_t position = low;
  for (int64_t i = low; i <= high; i++) {
    const double value = values[i];
    values[i] = values[position], values[position] = value;
    position += belongs(value);
  }
  return position;
}

// Selects the value of rank k (from 0) by partitions in place.
double select_by_parts(double* values, int64_t count, int64_t k) {
  int64_t low = 0, high = count - 1;
  while (low < high) {
    const double a = values[low], b = values[low + (high - low) / 2], c = values[high];
    const double pivot = larger(smaller(a, b), smaller(larger(a, b), c));
    int64_t end = move_down(values, low, high, [&](double value) { return value < pivot; });
    if (k < end) {
      high = end - 1;
      continue;
    }
    if (end == low)
      end = move_down(values, low, high, [&](double value) { return value == pivot; });
    if (k < end) return pivot;
    low = end;
  }
  return values[k];
}

// Selects the value of rank k (from 0), in place. Evenly spaced values bound it: the residuals of a
// wall in an image rise and fall along its rows, where three values give poor pivots.
double select(double* values, int64_t count, int64_t k) {
  constexpr int SAMPLES = 512, MARGIN = 48;  // four standard deviations of a median's rank
  if (count < 4 * SAMPLES) return select_by_parts(values, count, k);
  double samples[SAMPLES];
  for (int j = 0; j < SAMPLES; j++) samples[j] = values[count / SAMPLES * j + count / SAMPLES / 2];
  const int64_t middle = k * SAMPLES / count;
  const double low = select_by_parts(samples, SAMPLES, larger(middle - MARGIN, int64_t(0))),
               high = select_by_parts(samples, SAMPLES,
                                      smaller(middle + MARGIN, int64_t(SAMPLES - 1)));
  int64_t below = 0;
  for (int64_t i = 0; i < count; i++) below += values[i] < low;
  const int64_t within = move_down(values, 0, count - 1,
                                   [&](double value) { return (value >= low) & (value <= high); });
  const bool is_within = k >= below && k < below + within;
  return is_within ? select_by_parts(values, within, k - below) : select_by_parts(values, count, k);
}

// Calls `visit` with each run of equal labels, not negative, and its first and past-the-end index.
// Many runs are long, and counting point by point would wait for every write of a count.
template <class Visit>
void visit_runs(Longs labels, int64_t n, const Visit& visit) {
  for (int64_t from = 0, to = 0; from < n; from = to) {
    while (to < n && labels[to] == labels[from]) to++;
    if (labels[from] >= 0) visit(labels[from], from, to);
  }
}

// Calls `visit` with each region and the first and past-the-end index of its points.
template <class Visit>
int64_t visit_regions(int64_t n, int64_t num, Longs counts, const Visit& visit) {
  int64_t start = 0;
  for (int64_t m = 0; m < num; start += counts[m++]) {
    if (counts[m] < 1 || counts[m] > n - start) return NO_SUCH_ROW;
    visit(m, start, start + counts[m]);
  }
  return DONE;
}

// Mean (3) and covariance (9) of weighted points, about zero if not centered.
void measure(Doubles x, Doubles y, Doubles z, Doubles weights, int64_t start, int64_t end,
             bool is_centered, double* mean, double* covariance) {
  double sums[4], squares[6];
  add_up(sums, start, end - start, [&](int64_t i, double* terms) {
    const double weight = weights[i];
    terms[0] = x[i] * weight, terms[1] = y[i] * weight, terms[2] = z[i] * weight;
    terms[3] = weight;
  });
  const double total = sums[3];
  for (int axis = 0; axis < 3; axis++) mean[axis] = is_centered ? sums[axis] / total : 0;
  const double a = mean[0], b = mean[1], c = mean[2];
  add_up(squares, start, end - start, [&](int64_t i, double* terms) {
    const double u = x[i] - a, v = y[i] - b, w = z[i] - c;
    const double wu = weights[i] * u, wv = weights[i] * v, ww = weights[i] * w;
    terms[0] = wu * u, terms[1] = wu * v, terms[2] = wu * w;
    terms[3] = wv * v, terms[4] = wv * w, terms[5] = ww * w;
  });
  const int index[9] = {0, 1, 2, 1, 3, 4, 2, 4, 5};
  for (int entry = 0; entry < 9; entry++) covariance[entry] = squares[index[entry]] / total;
}

// Median and mean square of the distances of points from a plane, and their weights.
void reweigh(Doubles x, Doubles y, Doubles z, int64_t start, int64_t end, Doubles mean,
             Doubles axis, double min_scale, double mad, double cut, double* weights,
             double& median, double& square) {
  const double a = mean[0], b = mean[1], c = mean[2], p = axis[0], q = axis[1], r = axis[2];
  const auto residual = [&](int64_t i) { return (x[i] - a) * p + (y[i] - b) * q + (z[i] - c) * r; };
  for (int64_t i = start; i < end; i++) {
    const double away = size_of(residual(i));
    weights[i] = away < double(INFINITE) ? away : double(INFINITE);
  }
  const int64_t count = end - start;
  double sum[1];
  add_up(sum, start, count, [&](int64_t i, double* term) { *term = weights[i] * weights[i]; });
  square = sum[0] / double(count);
  median = select(weights + start, count, (count - 1) / 2);
  const double min_unit = cut * larger(mad * median, min_scale);
  const double unit = min_unit > 0 ? min_unit : 1;
  for (int64_t i = start; i < end; i++) {
    const double ratio = residual(i) / unit, weight = larger(1 - ratio * ratio, 0.0);
    weights[i] = weight * weight;
  }
}

}  // namespace

// Segments.coordinates: coordinates (A, n) along the axes of regions, about their centers.
KERNEL segment_coordinates(int64_t n, int64_t num, int64_t num_axes, Doubles x, Doubles y,
                           Doubles z, Longs counts, Doubles centers, Doubles axes,
                           double* coordinates) {
  return visit_regions(n, num, counts, [&](int64_t m, int64_t start, int64_t end) {
    for (int64_t a = 0; a < num_axes; a++) {
      const double *center = centers + 3 * m, *axis = axes + 3 * (num_axes * m + a);
      const double p = axis[0], q = axis[1], r = axis[2];
      for (int64_t i = start; i < end; i++)
        coordinates[a * n + i] =
            (x[i] - center[0]) * p + (y[i] - center[1]) * q + (z[i] - center[2]) * r;
    }
  });
}

// Segments.rows, counts and sizes. Large regions are subsampled at a regular step to at most
// `max_points`.
KERNEL segment_rows(int64_t n, int64_t num, Longs labels, int64_t max_points, int64_t* counts,
                    int64_t* sizes, int64_t* ends, int64_t* rows) {
  if (max_points < 1) return TOO_WIDE;
  bool inside = true;
  for (int64_t m = 0; m < num; m++) sizes[m] = counts[m] = 0;
  visit_runs(labels, n, [&](int64_t m, int64_t from, int64_t to) {
    inside &= m < num;
    if (inside) sizes[m] += to - from;
  });
  if (!inside) return NO_SUCH_ROW;
  const auto step_of = [&](int64_t m) {
    return larger((sizes[m] + max_points - 1) / max_points, int64_t(1));
  };
  for (int64_t m = 0, start = 0; m < num; m++)
    ends[m] = start, start += (sizes[m] + step_of(m) - 1) / step_of(m);
  // counts[m] is the number of points up to the next sample.
  visit_runs(labels, n, [&](int64_t m, int64_t from, int64_t to) {
    const int64_t step = step_of(m);
    int64_t next = from + counts[m];
    for (; next < to; next += step) rows[ends[m]++] = next;
    counts[m] = next - to;
  });
  for (int64_t m = 0; m < num; m++) counts[m] = ends[m] - (m ? ends[m - 1] : 0);
  return DONE;
}

// Segments.moments: means and covariances of weighted points, about zero if not centered.
KERNEL segment_moments(int64_t n, int64_t num, Doubles x, Doubles y, Doubles z, Doubles weights,
                       Longs counts, int64_t is_centered, double* means, double* covariances) {
  return visit_regions(n, num, counts, [&](int64_t m, int64_t start, int64_t end) {
    measure(x, y, z, weights, start, end, is_centered, means + 3 * m, covariances + 9 * m);
  });
}

// Segments.reweigh: medians and mean squares of the distances of points from planes, and Tukey's
// bisquare weights of the distances in units of `cut` medians, at least `min_scale`.
KERNEL reweigh_segments(int64_t n, int64_t num, Doubles x, Doubles y, Doubles z, Longs counts,
                        Doubles means, Doubles axes, Doubles min_scale, double mad, double cut,
                        double* weights, double* medians, double* squares) {
  return visit_regions(n, num, counts, [&](int64_t m, int64_t start, int64_t end) {
    reweigh(x, y, z, start, end, means + 3 * m, axes + 3 * m, min_scale[m], mad, cut, weights,
            medians[m], squares[m]);
  });
}

// growth._fit_chunk: centers, covariances, normals of length sqrt(1 + slopes^2), mean noise, median
// and mean square residuals of the pixels in `rows`; buffers are (4, n).
KERNEL fit_pixel_regions(int64_t h, int64_t w, int64_t n, int64_t num, Doubles values, Doubles x,
                         Doubles y, Doubles noise, Longs rows, Longs counts, int64_t num_fits,
                         double mad, double cut, double min_spread, double* buffers,
                         double* centers, double* covariances, double* normals, double* mean_noise,
                         double* medians, double* squares) {
  if (num_fits < 1 || num_fits > MAX_WIDTH) return TOO_WIDE;
  if (!are_rows(rows, n, h * w)) return NO_SUCH_ROW;
  double *u = buffers, *v = u + n, *z = v + n, *weights = z + n;
  return visit_regions(n, num, counts, [&](int64_t m, int64_t start, int64_t end) {
    for (int64_t i = start, first = 0, row = 0; i < end; i++) {
      const int64_t pixel = rows[i], later = rows[smaller(i + AHEAD, n - 1)];
      __builtin_prefetch(values + later), __builtin_prefetch(noise + later);
      if (pixel < first || pixel >= first + w) row = pixel / w, first = row * w;
      u[i] = x[pixel - first], v[i] = y[row], z[i] = values[pixel], weights[i] = 1;
    }
    double sum[1], *center = centers + 3 * m, *s = covariances + 9 * m, *normal = normals + 3 * m;
    add_up(sum, start, end - start, [&](int64_t i, double* term) { *term = noise[rows[i]]; });
    mean_noise[m] = sum[0] / double(end - start);
    for (int64_t fit = 0; fit < num_fits; fit++) {
      measure(u, v, z, weights, start, end, true, center, s);
      // growth._fit_slopes
      const double determinant = s[0] * s[4] - s[1] * s[1], square = (s[0] + s[4]) * (s[0] + s[4]);
      const bool is_full = determinant > min_spread * square;
      const double divisor = is_full ? determinant : square > 0 ? square : 1;
      const double xx = is_full ? s[4] : s[0], xy = is_full ? -s[1] : s[1],
                   yy = is_full ? s[0] : s[4];
      normal[0] = -((xx * s[2] + xy * s[5]) / divisor), normal[2] = 1;
      normal[1] = -((xy * s[2] + yy * s[5]) / divisor);
      reweigh(u, v, z, start, end, center, normal, mean_noise[m], mad, cut, weights, medians[m],
              squares[m]);
    }
  });
}

// Segments.quantile, moments.kth_smallest: the value of a rank (from 0) in each region, NaN last.
KERNEL kth_values(int64_t n, int64_t num, Doubles values, Longs counts, Longs ranks, double* found,
                  double* scratch) {
  for (int64_t m = 0, i = 0; m < num; m++) {
    if (counts[m] < 0 || counts[m] > n - i) return NO_SUCH_ROW;
    int64_t count = 0;
    for (const int64_t end = i + counts[m]; i < end; i++)
      scratch[count] = values[i], count += values[i] == values[i];
    const bool is_known = ranks[m] >= 0 && ranks[m] < count;
    found[m] = is_known ? select(scratch, count, ranks[m]) : __builtin_nan("");
  }
  return DONE;
}

// extents.hull_candidates: whether the points (x, y) of each region are outside the octagon of its
// farthest points.
KERNEL hull_candidates(int64_t n, int64_t num, Doubles x, Doubles y, Longs counts, double rounding,
                       bool* outer) {
  return visit_regions(n, num, counts, [&](int64_t, int64_t start, int64_t end) {
    int64_t farthest[8];
    double maxima[8], largest = 0;
    for (int e = 0; e < 8; e++) farthest[e] = start, maxima[e] = -double(INFINITE);
    for (int64_t i = start; i < end; i++) {
      const double along[4] = {x[i], x[i] + y[i], y[i], y[i] - x[i]};
      for (int e = 0; e < 4; e++) {
        if (along[e] > maxima[e]) maxima[e] = along[e], farthest[e] = i;
        if (-along[e] > maxima[e + 4]) maxima[e + 4] = -along[e], farthest[e + 4] = i;
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
      offset[e] =
          u[e] * x[one] + v[e] * y[one] + rounding * larger(size_of(u[e]), size_of(v[e])) * largest;
    }
    for (int64_t i = start; i < end; i++) {
      bool inside = corners > 2;
      for (int e = 0; e < corners; e++) inside &= u[e] * x[i] + v[e] * y[i] > offset[e];
      outer[i] = !inside;
    }
  });
}
