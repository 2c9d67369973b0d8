// Least-squares planes of neighborhoods (torchrg/normals/pca.py) and their noise.
#include "plain.h"

// torchrg.normals.pca.fit_normals_pca. Patches as narrow as the rounding of their covariance are
// flagged and recomputed by the torch definition.
KERNEL fit_normals_pca(int64_t num_points, int64_t num_rows, int64_t k, Floats points, Ints indices,
                       Flagged mask, Floats resolution, double tolerance, double narrow_fraction,
                       float* normals, float* curvature, float* residual_rms, bool* valid,
                       bool* narrow) {
  const Lists lists = {num_points, num_rows, k, points, indices, mask};
  return visit_patches(lists, nullptr, num_rows, [&](int64_t, int64_t i, const Patch& patch) {
    float mean[3], covariance[6];
    moments(patch, patch.weight, patch.width, mean, covariance);
    Plane plane;
    decompose(covariance, plane);
    const float sum = covariance[0] + covariance[3] + covariance[5], low = float(plane.low);
    const float length = square_root(float(plane.high)), width = square_root(float(plane.middle));
    narrow[i] = !(width >= float(narrow_fraction) * length);
    valid[i] = width > larger(float(tolerance) * length, resolution[i]);
    write(valid[i] ? plane : Plane{}, normals, i);
    curvature[i] = valid[i] ? smaller(low / (sum > 0 ? sum : 1), 1 / 3.0f) : 0;
    residual_rms[i] = valid[i] ? square_root(low) : 0;
  });
}

namespace {

// torchrg.normals.consensus.noise._small_deviations: RMS residual of the first neighbors.
INLINE float of_few(const Patch& patch, int count, float breadth) {
  alignas(32) float weights[MAX_WIDTH], inside[MAX_WIDTH];
  const int width = padded(count);
  for (int j = 0; j < width; j++) inside[j] = j < count, weights[j] = inside[j] * patch.weight[j];
  if (weights[count - 1] == 0) return INFINITE;
  const Plane plane = fit_plane(patch, weights, width);
  if (!(float(plane.middle) > breadth * float(plane.high))) return INFINITE;
  Lanes squares{};
  for (int j = 0; j < width; j += LANES) {
    const Lanes residual = plane.residuals(patch, j);
    squares += residual * residual * load(inside + j);
  }
  return square_root(total(squares) / float(count - 3));
}

// torchrg.normals.consensus.noise._layered_deviations: residual of two parallel planes, without the
// checks of the result.
INLINE float of_layers(const Patch& patch, Plane plane, float count, int num_refits,
                       float min_count) {
  alignas(32) float sides[2][MAX_WIDTH];
  for (int turn = 0;; turn++) {
    float numbers[2], means[2][3], covariances[2][6], pooled[6];
    for (int j = 0; j < patch.width; j += LANES) {
      const Lanes weight = load(patch.weight + j);
      const Lanes upper = where(plane.residuals(patch, j) > 0, weight, all(0));
      store(sides[0] + j, upper), store(sides[1] + j, weight - upper);
    }
    for (int side = 0; side < 2; side++)
      numbers[side] = moments(patch, sides[side], patch.width, means[side], covariances[side]);
    if (turn == num_refits)
      return smaller(numbers[0], numbers[1]) < min_count ? INFINITE : float(plane.low);
    for (int i = 0; i < 6; i++)
      pooled[i] = numbers[0] / count * covariances[0][i] + numbers[1] / count * covariances[1][i];
    decompose(pooled, plane);
    float ends[2];
    for (int side = 0; side < 2; side++)
      ends[side] = means[side][0] * plane.a + means[side][1] * plane.b + means[side][2] * plane.c;
    plane.offset = (ends[0] + ends[1]) / 2;
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
  const Lists lists = {num_points, num_rows, k, points, indices, mask};
  return visit_patches(lists, nullptr, num_rows, [&](int64_t, int64_t i, const Patch& patch) {
    again[i] = false;
    for (int j = 1; j < k; j++)
      again[i] |= patch.x[j] == patch.x[j - 1] && patch.y[j] == patch.y[j - 1] &&
                  patch.z[j] == patch.z[j - 1];
    const float a = normals[3 * i], b = normals[3 * i + 1], c = normals[3 * i + 2];
    Lanes number{}, sx{}, sy{}, sz{};
    for (int j = 0; j < patch.width; j += LANES) {
      number += load(patch.weight + j);
      sx += load(patch.x + j), sy += load(patch.y + j), sz += load(patch.z + j);
    }
    const float count = total(number), some = larger(count, 1.0f);
    offsets[i] = total(sx) / some * a + total(sy) / some * b + total(sz) / some * c;
    Lanes second{}, fourth{};
    for (int j = 0; j < patch.width; j += LANES) {
      const Lanes residual = patch.along(a, b, c, j) - offsets[i];
      const Lanes square = residual * residual * load(patch.weight + j);
      second += square, fourth += square * square;
    }
    const float s2 = total(second), s4 = total(fourth);
    radius[i] = square_root(farthest(patch, patch.weight));
    whole[i] = valid[i] && count > 3 ? square_root(s2 / larger(count - 3, 1.0f)) : INFINITE;
    layered[i] = INFINITE;
    if (s4 * count < float(kurtosis) * s2 * s2 && is_finite(whole[i])) {
      const float square = of_layers(patch, {a, b, c, offsets[i], 0, 0, 0}, count, int(num_refits),
                                     float(min_count));
      const float deviation = square_root(square * count / larger(count - 4, 1.0f));
      if (deviation <= float(fraction) * whole[i]) layered[i] = deviation;
    }
    of_fewer[i] = few <= k ? of_few(patch, int(few), float(breadth)) : INFINITE;
    of_more[i] = more <= k ? of_few(patch, int(more), float(breadth)) : INFINITE;
  });
}

namespace {

// Order-preserving integer keys of floats, and back; the bits of negative floats are inverted.
INLINE int32_t as_key(float value) {
  int32_t key;
  __builtin_memcpy(&key, &value, sizeof key);
  return key < 0 ? key ^ INT32_MAX : key;
}
INLINE float of_key(int32_t key) {
  if (key < 0) key ^= INT32_MAX;
  float value;
  __builtin_memcpy(&value, &key, sizeof value);
  return value;
}

constexpr int QUICK_TURNS = 4;  // the fastest of 0 to 5 for 50 keys

INLINE Flags middle_of(Flags low, Flags high) { return (low & high) + ((low ^ high) >> 1); }

// The key of a given rank, from 1, among the k keys of each lane.
INLINE Flags select(const int32_t* keys, int k, Flags ranks) {
  Flags low = load(keys), high = low;
  for (int j = 1; j < k; j++) {
    const Flags key = load(keys + LANES * j);
    low = smaller(key, low), high = larger(key, high);
  }
  // Halve the range without its keys first, at a fourth of the cost.
  for (int turn = 0; turn < QUICK_TURNS; turn++) {
    const Flags middle = middle_of(low, high);
    Flags missing = ranks;
    for (int j = 0; j < k; j++) missing += load(keys + LANES * j) <= middle;
    const Flags is_high = missing <= 0;
    low = where(is_high, low, smaller(middle + 1, high)), high = where(is_high, middle, high);
  }
  while (total(low < high)) {
    const Flags middle = middle_of(low, high);
    Flags count{}, below = low, above = high;
    for (int j = 0; j < k; j++) {
      const Flags key = load(keys + LANES * j), within = key <= middle;
      count -= within;
      below = where(within, larger(key, below), below);
      above = where(within, above, smaller(key, above));
    }
    const Flags is_high = count >= ranks;
    low = where(is_high, where(count == ranks, below, low), above);
    high = where(is_high, below, where(count == ranks - 1, above, high));
  }
  return low;
}

// Gathers some adjacent columns of the neighbors of a row as keys, from a lane on; returns the
// number of counted neighbors.
template <int num_lanes>
INLINE int gather_keys(const float* column, int64_t num_columns, const int32_t* row,
                       const bool* counted, int64_t k, int lane, int32_t* keys) {
  int count = 0;
  for (int64_t j = 0; j < k; j++) {
    const bool counts = !counted || counted[j];
    count += counts;
    for (int l = 0; l < num_lanes; l++)
      keys[LANES * j + lane + l] = as_key(counts ? column[num_columns * row[j] + l] : INFINITE);
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
      const int count = width == 4
                            ? gather_keys<4>(column, num_columns, row, counted, k, lane, keys)
                            : gather_keys<1>(column, num_columns, row, counted, k, lane, keys);
      for (int l = lane; l < lane + width; l++) {
        ranks[l] = int(rank_of_all);
        if (mask) ranks[l] = larger(int(__builtin_ceilf(float(quantile) * float(count))), 1);
      }
    }
    const Flags selected = select(keys, int(k), load(ranks));
    for (int lane = 0; lane < LANES && start + lane < num_found; lane++)
      found[start + lane] = of_key(selected[lane]);
  }
  return DONE;
}
