// Boundaries of superpoints and the cost of merging: torchrg/regions/superpoints.py.
#include "plain.h"

namespace {

INLINE double dot(const double* a, const double* b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

INLINE void widen(const float* values, double* wide) {
  for (int axis = 0; axis < 3; axis++) wide[axis] = values[axis];
}

}  // namespace

// superpoints._contact_differences
KERNEL contact_differences(int64_t num_points, int64_t num_rows, int64_t k, Floats points,
                           Floats normals, Longs planes, Longs rows, Ints nearest,
                           double step_weight, double plane_weight, double* differences) {
  double normal[3], other[3], offset[3], change[3];
  for (int64_t q = 0; q < num_rows; q++, nearest += k, differences += k) {
    const int64_t i = rows[q];
    if (!is_row(i, num_points) || !are_rows(nearest, k, num_points)) return NO_SUCH_ROW;
    widen(normals + 3 * i, normal);
    for (int64_t j = 0; j < k; j++) {
      const int64_t t = nearest[j];
      widen(normals + 3 * t, other);
      const double sign = __builtin_copysign(1.0, dot(normal, other));
      for (int axis = 0; axis < 3; axis++) {
        offset[axis] = double(points[3 * t + axis]) - double(points[3 * i + axis]);
        change[axis] = other[axis] - normal[axis] * sign;
      }
      const double here = dot(offset, normal), there = dot(offset, other);
      const double step = smaller(here * here, there * there) / dot(offset, offset);
      const double is_other = planes[i] != planes[t];
      differences[j] = dot(change, change) + step_weight * step + plane_weight * is_other;
    }
  }
  return DONE;
}

// superpoints._aggregate: sums rows of equal pairs of different regions, in the order of the smaller
// region, then of the larger one.
KERNEL aggregate_boundaries(int64_t num_rows, int64_t num_starts, Ints a, Ints b, Doubles contacts,
                            Doubles differences, int64_t* starts, int64_t* others, int64_t* order,
                            int32_t* first, int32_t* second, double* sum_contacts,
                            double* sum_differences, int64_t* count) {
  if (num_rows > INT32_MAX) return TOO_WIDE;
  for (int64_t r = 0; r < num_starts; r++) starts[r] = others[r] = 0;
  for (int64_t e = 0; e < num_rows; e++) {
    const int64_t low = smaller(a[e], b[e]), high = larger(a[e], b[e]);
    if (low < 0 || high >= num_starts - 1) return NO_SUCH_ROW;
    starts[low + 1] += low != high, others[high + 1] += low != high;
  }
  for (int64_t r = 1; r < num_starts; r++) starts[r] += starts[r - 1], others[r] += others[r - 1];
  const int64_t num_different = num_starts ? starts[num_starts - 1] : 0;
  for (int64_t e = 0; e < num_rows; e++)
    if (a[e] != b[e]) second[others[larger(a[e], b[e])]++] = int32_t(e);
  for (int64_t q = 0; q < num_different; q++)
    order[starts[smaller(a[second[q]], b[second[q]])]++] = second[q];
  int64_t last = -1;
  for (int64_t q = 0; q < num_different; q++) {
    const int64_t e = order[q];
    const int32_t low = smaller(a[e], b[e]), high = larger(a[e], b[e]);
    if (last < 0 || first[last] != low || second[last] != high) {
      last++, first[last] = low, second[last] = high;
      sum_contacts[last] = sum_differences[last] = 0;
    }
    sum_contacts[last] += contacts ? contacts[e] : 1;
    sum_differences[last] += differences[e];
  }
  *count = last + 1;
  return DONE;
}

// superpoints._merge_costs
KERNEL merging_costs(int64_t num_regions, int64_t num_features, int64_t dims, int64_t num_borders,
                     Doubles size, Doubles means, Doubles low, Doubles high, Ints first,
                     Ints second, Doubles contacts, Doubles differences, double min_cost,
                     double bound, double* costs) {
  for (int64_t e = 0; e < num_borders; e++) {
    const int64_t a = first[e], b = second[e];
    if (!is_row(a, num_regions) || !is_row(b, num_regions)) return NO_SUCH_ROW;
    double difference = differences[e] / contacts[e] + min_cost;
    for (int64_t f = 0; f < num_features; f++) {
      const double step = means[a * num_features + f] - means[b * num_features + f];
      difference += step * step;
    }
    const double ward = size[a] * size[b] / (size[a] + size[b]);
    costs[e] = ward * difference / square_root(contacts[e]);
    for (int64_t d = 0; d < dims; d++)
      if (larger(high[a * dims + d], high[b * dims + d]) -
              smaller(low[a * dims + d], low[b * dims + d]) >
          bound)
        costs[e] = __builtin_inf();
  }
  return DONE;
}

// superpoints._cheapest
KERNEL cheapest_boundaries(int64_t num_borders, int64_t num_regions, Ints first, Ints second,
                           Doubles costs, double* lowest, int64_t* best) {
  for (int64_t r = 0; r < num_regions; r++) best[r] = num_borders;
  for (int64_t e = 0; e < num_borders; e++)
    for (int end = 0; end < 2; end++) {
      const int64_t r = end ? second[e] : first[e];
      if (!is_row(r, num_regions)) return NO_SUCH_ROW;
      if (costs[e] < lowest[r]) lowest[r] = costs[e], best[r] = e;
    }
  return DONE;
}
