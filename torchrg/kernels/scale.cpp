// Robust scales of short rows, bit-identical to torchrg/robust/scale.py.
#include "plain.h"

namespace {

constexpr int QUICK_PASSES = 3;      // counting passes, at half the cost of the other passes
constexpr float QUARTERS = 0.3336f;  // normal data: Qn's difference / interquartile range

struct Around {
  int count;           // differences at most the pivot
  float below, above;  // the largest of them, and the smallest above; the pivot if not searched
};

// `row` is sorted, followed by infinities as far as a window may reach.
template <bool looks>
INLINE Around look_around(const float* row, int n, float pivot) {
  Flags count{};
  Lanes below{}, above = all(INFINITE);
  for (int lag = 1; lag <= n / 2; lag++)
    for (int i = 0; i < n - lag; i += LANES) {
      const Lanes difference = load(row + i + lag) - load(row + i);
      const Flags within = difference <= pivot;
      count += within;
      if (!looks) continue;
      below = larger(below, where(within, difference, all(0)));
      above = smaller(above, where(difference > pivot, difference, all(INFINITE)));
    }
  if (!looks) return {-total(count), pivot, pivot};
  return {-total(count), largest(below), -largest(-above)};
}

// The C(h, 2)-th smallest difference of a row.
//
// Bisection: differences below the pivot are too small (low), the remaining ones are not (high).
float majority_difference(const float* row, int n) {
  const int lags = n / 2, rank = lags * (lags + 1) / 2;
  const float num_all = lags * n - rank;
  float low = 0, high = row[n - 1] - row[0], num_low = 0, num_high = num_all;
  if (high == 0) return 0;
  float pivot = (row[3 * n / 4] - row[n / 4]) * QUARTERS;
  if (!(pivot > 0 && pivot < high)) pivot = high * 0.5f;
  for (int turn = 0;; turn++) {
    const bool looks = turn >= QUICK_PASSES;
    const Around found =
        looks ? look_around<true>(row, n, pivot) : look_around<false>(row, n, pivot);
    if (found.count == rank || found.count == rank - 1) {
      if (looks) return found.count == rank ? found.below : found.above;
      turn = QUICK_PASSES - 1;
      continue;
    }
    if (found.count < rank) {
      if (found.above >= high) return high;
      low = pivot, num_low = found.count;
    } else {
      if (found.below <= low) return found.below;
      high = found.below, num_high = found.count;
    }
    const float middle = low + (high - low) * 0.5f;
    pivot = low + (high - low) * (rank - 0.5f - num_low) / larger(num_high - num_low, 1.0f);
    // Small differences are evenly spaced, large ones sparse.
    if (num_high == num_all && num_low > 0) pivot = low * (rank - 0.5f) / num_low;
    const bool in_turn = turn > 2 * QUICK_PASSES && turn % 2;
    if (in_turn || !(pivot > low && pivot < high)) pivot = middle;
    if (!(pivot > low && pivot < high)) pivot = low;
  }
}

}  // namespace

// torchrg.robust.scale._majority_difference of sorted rows; NaN where a difference is not finite.
KERNEL majority_differences(int64_t num_rows, int64_t n, Floats rows, float* found) {
  if (n < 2 || n > MAX_WIDTH) return TOO_WIDE;
  alignas(32) float row[MAX_WIDTH + LANES];
  for (int i = 0; i < LANES; i++) row[n + i] = INFINITE;
  for (int64_t i = 0; i < num_rows; i++) {
    __builtin_memcpy(row, rows + i * n, n * sizeof *row);
    const bool usable = is_finite(row[n - 1] - row[0]);
    found[i] = usable ? majority_difference(row, int(n)) : __builtin_nanf("");
  }
  return DONE;
}
