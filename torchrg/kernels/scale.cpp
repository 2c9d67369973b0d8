// Robust scales of short rows, as torchrg/robust/scale.py defines them, to the bit.
#include "plain.h"

namespace {

constexpr int QUICK_PASSES = 4;     // passes that only count, at a third of the cost of the others
constexpr float QUARTERS = 0.3336f;  // Qn's difference by that of the quartiles, of normal data

struct Around {
  int count;           // differences at most the pivot
  float below, above;  // the largest of them, and the smallest beyond
};

// `row` ascends, with infinity behind its n values for as long as a window may reach.
INLINE int count_within(const float* row, int n, float pivot) {
  Flags count{};
  for (int lag = 1; lag <= n / 2; lag++)
    for (int i = 0; i < n - lag; i += LANES) count += load(row + i + lag) - load(row + i) <= pivot;
  return -total(count);
}

INLINE Around look_around(const float* row, int n, float pivot) {
  Flags count{};
  Lanes below{}, above = all(INFINITE);
  for (int lag = 1; lag <= n / 2; lag++)
    for (int i = 0; i < n - lag; i += LANES) {
      const Lanes difference = load(row + i + lag) - load(row + i);
      const Flags within = difference <= pivot, beyond = difference > pivot;
      count += within;
      below = larger(below, where(within, difference, all(0)));
      above = smaller(above, where(beyond, difference, all(INFINITE)));
    }
  return {-total(count), largest(below), -largest(-above)};
}

// The C(h, 2)-th smallest difference of a row, of which the last values may be infinite.
//
// A pivot moves between differences that are too small (low) and those that are not (high).
float majority_difference(const float* row, int n) {
  const int lags = n / 2, rank = lags * (lags + 1) / 2;
  int num_finite = n, within = 0;
  while (num_finite > 0 && !is_finite(row[num_finite - 1])) num_finite--;
  for (int lag = 1; lag <= lags && lag < num_finite; lag++) within += num_finite - lag;
  if (within < rank) return INFINITE;
  float low = 0, high = row[num_finite - 1] - row[0], num_low = 0, num_high = within;
  if (high == 0) return 0;
  float pivot = (row[3 * n / 4] - row[n / 4]) * QUARTERS;
  if (!(pivot > 0 && pivot < high)) pivot = high * 0.5f;
  for (int turn = 0;; turn++) {
    if (turn < QUICK_PASSES) {
      const int count = count_within(row, n, pivot);
      if (count == rank || count == rank - 1) {
        turn = QUICK_PASSES - 1;
        continue;
      }
      if (count < rank)
        low = pivot, num_low = count;
      else
        high = pivot, num_high = count;
    } else {
      const Around found = look_around(row, n, pivot);
      if (found.count == rank) return found.below;
      if (found.count == rank - 1) return found.above;
      if (found.count < rank) {
        low = pivot, num_low = found.count;
        if (found.above >= high) return high;
      } else {
        high = found.below, num_high = found.count;
        if (found.below <= low) return found.below;
      }
    }
    const float middle = low + (high - low) * 0.5f;
    pivot = low + (high - low) * (rank - 0.5f - num_low) / larger(num_high - num_low, 1.0f);
    const bool in_turn = turn > 2 * QUICK_PASSES && turn % 2;
    if (in_turn || !(pivot > low && pivot < high)) pivot = middle;
    if (!(pivot > low && pivot < high)) pivot = low;
  }
}

// Copies values, none of them NaN, into a row that ascends, with infinity behind them.
INLINE void sort(const float* values, int n, float* row) {
  for (int i = 0; i < n; i++) {
    int place = i;
    for (; place > 0 && row[place - 1] > values[i]; place--) row[place] = row[place - 1];
    row[place] = values[i];
  }
  for (int i = 0; i < LANES; i++) row[n + i] = INFINITE;
}

}  // namespace

// torchrg.robust.scale._majority_difference of sorted rows; NaN where a difference is not finite.
KERNEL majority_differences(int64_t num_rows, int64_t n, Floats rows, float* found) {
  if (n < 2 || n > MOST) return TOO_WIDE;
  alignas(32) float row[MOST + LANES];
  for (int i = 0; i < LANES; i++) row[n + i] = INFINITE;
  for (int64_t i = 0; i < num_rows; i++) {
    __builtin_memcpy(row, rows + i * n, n * sizeof *row);
    const bool usable = is_finite(row[n - 1] - row[0]);
    found[i] = usable ? majority_difference(row, int(n)) : __builtin_nanf("");
  }
  return DONE;
}

// torchrg.regions.edges.are_coplanar of points (3, N) and the normals of the points of n lists.
KERNEL are_coplanar(int64_t num_points, int64_t num_rows, int64_t k, Floats points, Ints indices,
                    Flagged mask, Floats normals, Flagged asked, Flagged compared, double factor,
                    double floor, bool* coplanar) {
  if (k < 1 || k > MOST) return TOO_WIDE;
  alignas(32) float residuals[MOST], values[MOST], row[MOST + LANES];
  const float *x = points, *y = points + num_points, *z = points + 2 * num_points;
  for (int64_t i = 0; i < num_rows; i++, indices += k, asked += k, coplanar += k) {
    bool needed = false;
    for (int j = 0; j < k; j++) needed |= asked[j], coplanar[j] = false;
    if (!are_rows(indices, k, num_points)) return NO_SUCH_ROW;
    if (!needed) continue;
    const float a = normals[3 * i], b = normals[3 * i + 1], c = normals[3 * i + 2];
    const float x0 = x[indices[0]], y0 = y[indices[0]], z0 = z[indices[0]];
    const bool *counted = mask ? mask + i * k : nullptr,
               *chosen = compared ? compared + i * k : counted;
    float sq_radius = 0;
    int n = 0;
    bool usable = true;
    for (int j = 0; j < k; j++) {
      const float u = x[indices[j]] - x0, v = y[indices[j]] - y0, w = z[indices[j]] - z0;
      residuals[j] = size_of(u * a + v * b + w * c);
      if (!counted || counted[j]) sq_radius = larger(sq_radius, u * u + v * v + w * w);
      if (chosen && !chosen[j]) continue;
      usable &= residuals[j] == residuals[j];
      values[n++] = residuals[j];
    }
    if (n == 0 || !usable) continue;
    sort(values, n, row);
    const float median = n % 2 ? row[n / 2] : row[n / 2 - 1] + (row[n / 2] - row[n / 2 - 1]) / 2;
    const float scale = n < 2 ? 0 : float(factor) * majority_difference(row, n);
    const float limit = median + 2 * larger(scale, float(floor) * square_root(sq_radius));
    for (int j = 0; j < k; j++) coplanar[j] = residuals[j] <= limit;
  }
  return DONE;
}
