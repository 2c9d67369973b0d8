// Least-squares planes of neighborhoods (torchrg/normals/pca.py) and their noise.
#include "patches.h"

// torchrg.normals.pca.fit_normals_pca. Patches as narrow as the rounding of their covariance are
// flagged and recomputed by the torch definition.
KERNEL fit_normals_pca(int64_t num_points, int64_t num_rows, int64_t k, Floats points, Ints indices,
                       Flagged mask, Floats resolution, double tolerance, double narrow_fraction,
                       float* normals, float* curvature, float* residual_rms, bool* valid,
                       bool* narrow) {
  const Lists lists = {num_points, num_rows, k, points, indices, mask};
  return visit_patches(lists, nullptr, num_rows, [&](const Rows& rows, const Patch& patch) {
    const Moments found = moments(patch, patch.weight, patch.width);
    const Fits fits = decompose(found.covariance);
    const Lanes sum = found.covariance[0] + found.covariance[3] + found.covariance[5];
    const Lanes length = roots_of(fits.high), width = roots_of(fits.middle);
    const Flags is_wide = width >= float(narrow_fraction) * length;
    const Flags is_valid = width > larger(float(tolerance) * length, rows.of(resolution));
    const Lanes low = where(is_valid, fits.low, all(0));
    rows.write(where(is_valid, fits.normal, Vectors{}), normals);
    rows.write(smaller(low / or_one(sum), all(1 / 3.0f)), curvature);
    rows.write(roots_of(low), residual_rms);
    rows.write(~is_wide, narrow), rows.write(is_valid, valid);
  });
}

namespace {

// torchrg.normals.consensus.noise._small_deviations: RMS residual of the first neighbors.
INLINE Lanes of_few(const Patch& patch, int count, float breadth) {
  const Fits planes = fit_planes(patch, patch.weight, count);
  const Lanes square = sum_of(count, [&](int j) {
    const Lanes residual = planes.residuals(patch, j);
    return residual * residual;
  });
  const Flags is_broad = planes.middle > breadth * planes.high;
  return where(is_broad & (patch.weight[count - 1] > 0), roots_of(square / float(count - 3)),
               all(INFINITE));
}

// torchrg.normals.consensus.noise._layered_deviations: mean squares of the residuals from two
// parallel planes, without the checks of the result.
Lanes of_layers(const Patch& patch, Planes planes, Lanes count, int num_refits, float min_count) {
  Column upper, lower;
  Lanes square{};
  for (int turn = 0;; turn++) {
    for (int j = 0; j < patch.width; j++) {
      const Lanes weight = patch.weight[j];
      upper.set(j, where(planes.residuals(patch, j) > 0, weight, all(0)));
      lower.set(j, weight - upper[j]);
    }
    const Lanes number = sum(upper, patch.width);
    if (turn == num_refits)
      return where(smaller(number, count - number) < min_count, all(INFINITE), square);
    const Moments above = moments(patch, upper, patch.width);
    const Moments below = moments(patch, lower, patch.width);
    Sums<6> pooled;
    for (int i = 0; i < 6; i++)
      pooled.sums[i] =
          above.count / count * above.covariance[i] + below.count / count * below.covariance[i];
    const Fits fits = decompose(pooled);
    planes = fits, square = fits.low;
    planes.offset = (dot(planes.normal, above.mean) + dot(planes.normal, below.mean)) / 2;
  }
}

}  // namespace

// torchrg.normals.consensus.noise._measure_neighborhoods: plane residuals of all neighbors and of
// the `few` and `more` nearest ones; `layered`: residual of two planes for layered neighborhoods.
KERNEL survey(int64_t num_points, int64_t num_rows, int64_t k, Floats points, Ints indices,
              Flagged mask, Floats normals, Flagged valid, int64_t few, int64_t more,
              double breadth, double kurtosis, double fraction, int64_t num_refits,
              int64_t min_count, float* offsets, float* radius, float* whole, float* layered,
              bool* again, float* of_fewer, float* of_more) {
  if (few < 4 || more < 4 || uint64_t(num_refits) > MAX_WIDTH) return TOO_WIDE;
  Patch thick;
  const Lists lists = {num_points, num_rows, k, points, indices, mask};
  Rows flat;
  flat.used = 0;
  const auto try_layers = [&] {
    gather(lists, flat, thick);
    const Lanes count = sum(thick.weight, thick.width);
    const Lanes square = of_layers(thick, planes_of(flat, normals, offsets), count, int(num_refits),
                                   float(min_count));
    const Lanes found = roots_of(square * count / larger(count - 4, all(1)));
    const Flags is_layered = found <= float(fraction) * flat.of(whole);
    flat.write(where(is_layered, found, all(INFINITE)), layered), flat.used = 0;
  };
  const int64_t status =
      visit_patches(lists, nullptr, num_rows, [&](const Rows& rows, const Patch& patch) {
        Flags repeats{};
        for (int j = 1; j < k; j++) {
          const Vectors one = patch[j], other = patch[j - 1];
          repeats |= (one.x == other.x) & (one.y == other.y) & (one.z == other.z);
        }
        const Sums<4> sums = add_up<4>(patch.width, [&](int j, Lanes* sum) {
          sum[0] += patch.weight[j], add(patch[j], sum + 1);
        });
        const Lanes count = sums[0];
        const Vectors center = Vectors{sums[1], sums[2], sums[3]} / larger(count, all(1));
        const Vectors normal = rows.vectors(normals);
        const Planes planes = {normal, dot(normal, center)};
        const Sums<2> powers = add_up<2>(patch.width, [&](int j, Lanes* sum) {
          const Lanes residual = planes.residuals(patch, j);
          const Lanes square = residual * residual * patch.weight[j];
          sum[0] += square, sum[1] += square * square;
        });
        const Lanes deviation =
            where(rows.flags(valid) & (count > 3), roots_of(powers[0] / larger(count - 3, all(1))),
                  all(INFINITE));
        const Flags is_flat =
            (powers[1] * count < float(kurtosis) * powers[0] * powers[0]) & (deviation < INFINITE);
        rows.write(planes.offset, offsets), rows.write(deviation, whole);
        rows.write(all(INFINITE), layered);
        rows.write(roots_of(farthest(patch, patch.weight)), radius);
        rows.write(few <= k ? of_few(patch, int(few), float(breadth)) : all(INFINITE), of_fewer);
        rows.write(more <= k ? of_few(patch, int(more), float(breadth)) : all(INFINITE), of_more);
        rows.write(repeats, again);
        for (int l = 0; l < rows.used; l++)
          if (is_flat[l] && flat.add(rows.numbers[l])) try_layers();
      });
  if (flat.used > 0) try_layers();
  return status;
}

namespace {

// Order-preserving integer keys of the bits of floats, and back: negative ones are inverted.
INLINE Flags ordered(Flags bits) { return bits ^ ((bits >> 31) & INT32_MAX); }

constexpr int QUICK_TURNS = 4;  // the fastest of 0 to 5 for 50 keys

INLINE Flags middle_of(Flags low, Flags high) { return (low & high) + ((low ^ high) >> 1); }

// Of the k values of each lane, given as bits, the value of a rank, from 1.
INLINE Flags select(int32_t* keys, int k, Flags ranks) {
  Flags low = ordered(load(keys)), high = low;
  for (int j = 0; j < k; j++) {
    const Flags key = ordered(load(keys + LANES * j));
    store(keys + LANES * j, key), low = smaller(key, low), high = larger(key, high);
  }
  const Flags num_above = k - ranks;
  // Halve the range without its keys first, at a fourth of the cost.
  for (int turn = 0; turn < QUICK_TURNS; turn++) {
    const Flags middle = middle_of(low, high);
    Flags missing = num_above;
    for (int j = 0; j < k; j++) missing += load(keys + LANES * j) > middle;
    const Flags is_high = missing >= 0;
    low = where(is_high, low, smaller(middle + 1, high)), high = where(is_high, middle, high);
  }
  while (is_any(low < high)) {
    const Flags middle = middle_of(low, high);
    Flags missing = num_above, below = low, above = high;
    for (int j = 0; j < k; j++) {
      const Flags key = load(keys + LANES * j), beyond = key > middle;
      missing += beyond;
      below = where(beyond, below, larger(key, below));
      above = where(beyond, smaller(key, above), above);
    }
    const Flags is_high = missing >= 0;
    low = where(is_high, where(missing == 0, below, low), above);
    high = where(is_high, below, where(missing == -1, above, high));
  }
  return ordered(low);
}

// Gathers one or four columns of the neighbors of a row; returns the number of counted neighbors.
template <class T>
INLINE int gather_values(Floats column, int64_t num_columns, Ints row, Flagged counted, int64_t k,
                         int32_t* keys) {
  int count = 0;
  for (int64_t j = 0; j < k; j++) {
    const bool counts = !counted || counted[j];
    const T found = counts ? read_as<T>(column + num_columns * row[j]) : T{} + INFINITE;
    __builtin_memcpy(keys + LANES * j, &found, sizeof found);
    count += counts;
  }
  return count;
}

}  // namespace

// torchrg.normals.consensus.noise._neighbor_quantiles of columns; one lane per result.
KERNEL neighbor_quantiles(int64_t num_points, int64_t num_columns, int64_t num_rows, int64_t k,
                          Floats values, Ints indices, Flagged mask, double quantile,
                          int64_t rank_of_all, float* found) {
  if (k < 1 || k > MAX_WIDTH || !(quantile >= 0 && quantile <= 1)) return TOO_WIDE;
  alignas(32) int32_t keys[MAX_WIDTH * LANES], ranks[LANES];
  const int64_t num_found = num_rows * num_columns;
  for (int64_t start = 0; start < num_found; start += LANES) {
    for (int lane = 0, width = 1; lane < LANES; lane += width) {
      const int64_t entry = smaller(start + lane, num_found - 1), i = entry / num_columns;
      const int32_t* row = indices + i * k;
      const bool* counted = mask ? mask + i * k : nullptr;
      const float* column = values + entry % num_columns;
      if (!are_rows(row, k, num_points)) return NO_SUCH_ROW;
      width = num_columns % 4 == 0 && start + lane + 4 <= num_found ? 4 : 1;
      const int count =
          width == 4 ? gather_values<FourFloats>(column, num_columns, row, counted, k, keys + lane)
                     : gather_values<float>(column, num_columns, row, counted, k, keys + lane);
      const float rank = larger(__builtin_ceilf(float(quantile) * float(count)), 1.0f);
      for (int l = lane; l < lane + width; l++) ranks[l] = int(mask ? rank : rank_of_all);
    }
    const Flags selected = select(keys, int(k), load(ranks));
    const int64_t count = smaller(num_found - start, int64_t(LANES));
    __builtin_memcpy(found + start, &selected, uint64_t(count) * sizeof *found);
  }
  return DONE;
}
