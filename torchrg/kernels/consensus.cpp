// Inner loops of consensus normals: each neighborhood stays in the cache for all of its steps.
// See torchrg/normals/consensus/ for definitions, and torchrg/normals/jet.py for paraboloids.
#include "plain.h"

namespace {

// Constants of torchrg/normals/consensus/constants.py, in the order passed.
struct Constants {
  float vote_reach, vote_falloff, fit_reach, fit_falloff, gap, corner_limit, corner_fraction;
  float num_refits, num_alternations, minimum;
};

struct Meeting {
  Plane plane;
  float deviation;
};

INLINE float sum(const float* values, int width) {
  Lanes lanes{};
  for (int j = 0; j < width; j += LANES) lanes += load(values + j);
  return total(lanes);
}

INLINE float product(const float* a, const float* b, int width) {
  Lanes lanes{};
  for (int j = 0; j < width; j += LANES) lanes += load(a + j) * load(b + j);
  return total(lanes);
}

INLINE void residuals(const Patch& patch, const Plane& plane, float* distances) {
  for (int j = 0; j < patch.width; j += LANES) store(distances + j, plane.residuals(patch, j));
}

// hypotheses._refit
INLINE void refit(const Patch& patch, const float* weights, float reach, bool bisquare,
                  Plane& plane) {
  alignas(32) float voted_weights[MAX_WIDTH];
  for (int j = 0; j < patch.width; j += LANES) {
    const Lanes residual = plane.residuals(patch, j) / reach;
    Lanes near = positive(1 - residual * residual);
    if (bisquare) near *= near;
    store(voted_weights + j, load(weights + j) * near);
  }
  const Plane fitted = fit_plane(patch, voted_weights, patch.width);
  if (float(fitted.middle) > 1e-6f * float(fitted.high)) plane = fitted;
}

// hypotheses.vote_planes
Plane vote(const Patch& patch, const float* counted, float noise, const float* start,
           const int64_t* ranks, int64_t num_pairs, const Constants& constants) {
  alignas(32) float weights[MAX_WIDTH], nearness[MAX_WIDTH];
  const float maximum = farthest(patch, counted), far = maximum > 0 ? maximum : 1;
  for (int j = 0; j < patch.width; j += LANES) {
    const Lanes near = patch.sq_lengths(j) / far;
    store(nearness + j, near);
    store(weights + j, (1 - constants.vote_falloff * near) * load(counted + j));
  }
  const float reach = constants.vote_reach * noise;
  Plane plane = {start[0], start[1], start[2], 0, 0, 0, 0};
  float best = support(patch, weights, plane.a / reach, plane.b / reach, plane.c / reach, 0);
  for (int64_t pair = 0; pair < num_pairs; pair++) {
    const int64_t p = ranks[2 * pair], q = ranks[2 * pair + 1];
    float a = patch.y[p] * patch.z[q] - patch.z[p] * patch.y[q];
    float b = patch.z[p] * patch.x[q] - patch.x[p] * patch.z[q];
    float c = patch.x[p] * patch.y[q] - patch.y[p] * patch.x[q];
    const float sq_area = a * a + b * b + c * c;
    if (!(sq_area > 0)) continue;
    const float length = square_root(sq_area);
    a /= length, b /= length, c /= length;
    const float score = support(patch, weights, a / reach, b / reach, c / reach, 0);
    if (score > best) best = score, plane.a = a, plane.b = b, plane.c = c;
  }
  for (int i = 0; i < constants.num_refits; i++) refit(patch, weights, reach, false, plane);
  for (int j = 0; j < patch.width; j += LANES)
    store(weights + j, (1 - constants.fit_falloff * load(nearness + j)) * load(counted + j));
  for (int i = 0; i < constants.num_refits; i++)
    refit(patch, weights, constants.fit_reach * noise, true, plane);
  return plane;
}

// hypotheses._off_surface: weights of the points off a surface, on its more populated side.
INLINE void beyond(const Patch& patch, const float* distances, float gap, float* flags) {
  Lanes over{}, under{};
  for (int j = 0; j < patch.width; j += LANES) {
    over += where(load(distances + j) > gap, load(patch.weight + j), all(0));
    under += where(load(distances + j) < -gap, load(patch.weight + j), all(0));
  }
  const float sign = total(under) <= total(over) ? 1 : -1;
  for (int j = 0; j < patch.width; j += LANES)
    store(flags + j, where(load(distances + j) * sign > gap, load(patch.weight + j), all(0)));
}

INLINE void near(const Patch& patch, const float* distances, float gap, const float* counted,
                 float* flags) {
  for (int j = 0; j < patch.width; j += LANES)
    store(flags + j, where(magnitude(load(distances + j)) <= gap, load(counted + j), all(0)));
}

INLINE float side(float sum) { return sum >= 0 ? 1 : -1; }

// hypotheses.fit_wedges, or fit_corners if there is a third group of points. Alternates between
// planes and their points; returns the points of each plane and signed distances to the surface.
Meeting alternate(const Patch& patch, int count, float* first, float* second, float* third,
                  float* outer, const Constants& constants) {
  alignas(32) float r[MAX_WIDTH], s[MAX_WIDTH], t[MAX_WIDTH];
  const int width = patch.width;
  bool present = true;
  float cuts = 0;
  Plane one, other, last;
  for (int turn = 0; turn <= constants.num_alternations; turn++) {
    const float fewest = smaller(sum(first, width), sum(second, width));
    present &= (third ? smaller(fewest, sum(third, width)) : fewest) >= constants.minimum;
    if (turn == constants.num_alternations) break;
    one = fit_plane(patch, first, width), other = fit_plane(patch, second, width);
    residuals(patch, one, r), residuals(patch, other, s);
    const float u = side(product(r, second, width)), v = side(product(s, first, width));
    for (int j = 0; j < width; j += LANES) {
      const Lanes e = load(r + j) * u, f = load(s + j) * v, weight = load(patch.weight + j);
      store(r + j, where(f > e, weight, all(0))), store(outer + j, smaller(e, f));
    }
    if (third) {
      last = fit_plane(patch, third, width), residuals(patch, last, t);
      for (int j = 0; j < width; j += LANES) store(first + j, load(first + j) + load(second + j));
      const float w = side(product(t, first, width));
      if (cuts == 0) cuts = side(product(outer, third, width));
      for (int j = 0; j < width; j += LANES) {
        const Lanes pair = load(outer + j) * cuts, added = load(t + j) * w;
        store(outer + j, smaller(added, pair) * cuts);
        store(third + j, where(pair > added, load(patch.weight + j), all(0)));
      }
    }
    for (int j = 0; j < width; j += LANES) {
      const Lanes weight = load(patch.weight + j);
      const Lanes left = weight - (third ? load(third + j) : all(0));
      store(outer + j, load(outer + j) * weight);
      store(first + j, load(r + j) * left), store(second + j, left - load(first + j));
    }
  }
  const float freedom = count - (third ? 9 : 6), squares = product(outer, outer, width);
  const Plane& result = third && third[0] > 0 ? last : second[0] > 0 ? other : one;
  return {result, present ? square_root(squares / larger(freedom, 1.0f)) : INFINITE};
}

// hypotheses.fit_meeting_planes
Meeting meet(const Patch& patch, const Plane& voted, float noise, int count, const int64_t* ranks,
             int64_t num_pairs, const Constants& constants) {
  alignas(32) float first[MAX_WIDTH], second[MAX_WIDTH], third[MAX_WIDTH];
  alignas(32) float outer[MAX_WIDTH], remaining[MAX_WIDTH];
  const int width = patch.width;
  const float gap = constants.gap * noise;
  residuals(patch, voted, remaining);
  near(patch, remaining, gap, patch.weight, first), beyond(patch, remaining, gap, second);
  const Meeting best = alternate(patch, count, first, second, nullptr, outer, constants);
  if (!(best.deviation > constants.corner_limit * noise)) return best;
  const float minimum = constants.corner_fraction * best.deviation;
  // Three planes: start from the two and the points off them.
  beyond(patch, outer, gap, third);
  for (int j = 0; j < width; j += LANES) {
    const Lanes on = 1 - load(third + j), is_first = load(first + j);
    store(second + j, (load(patch.weight + j) - is_first) * on), store(first + j, is_first * on);
  }
  const Meeting by_two = alternate(patch, count, first, second, third, outer, constants);
  // Three planes: start from the voted plane and the plane voted by the remaining points.
  residuals(patch, voted, outer);
  near(patch, outer, gap, patch.weight, first);
  int anchor = 0;
  for (int j = 0; j < width; j++) remaining[j] = patch.weight[j] - first[j];
  while (anchor < width && remaining[anchor] == 0) anchor++;
  if (anchor == width) anchor = 0;
  Patch moved = patch;
  for (int j = 0; j < width; j++) {
    moved.x[j] -= patch.x[anchor], moved.y[j] -= patch.y[anchor], moved.z[j] -= patch.z[anchor];
    if (patch.weight[j] == 0) moved.x[j] = moved.y[j] = moved.z[j] = 0;
  }
  const Plane start = fit_plane(moved, remaining, width);
  const float normal[3] = {start.a, start.b, start.c};
  const Plane other = vote(moved, remaining, noise, normal, ranks, num_pairs, constants);
  residuals(moved, other, outer);
  near(moved, outer, gap, remaining, second);
  for (int j = 0; j < width; j++) third[j] = remaining[j] - second[j];
  const Meeting by_votes = alternate(patch, count, first, second, third, outer, constants);
  Meeting three = by_two.deviation < minimum ? by_two : Meeting{best.plane, minimum};
  if (by_votes.deviation < three.deviation) three = by_votes;
  return three.deviation < minimum ? three : best;
}

// Compacts the points of nonzero weight to the front; returns their number.
INLINE int compact(Patch& patch) {
  int count = 0;
  for (int j = 0; j < patch.width; j++) {
    if (patch.weight[j] == 0) continue;
    patch.x[count] = patch.x[j], patch.y[count] = patch.y[j], patch.z[count] = patch.z[j];
    patch.weight[count++] = 1;
  }
  for (int j = count; j < patch.width; j++)
    patch.x[j] = patch.y[j] = patch.z[j] = patch.weight[j] = 0;
  patch.width = padded(larger(count, 1));
  return count;
}

}  // namespace

// surfaces.broken_planes: the voted plane, and the best of two or three intersecting planes.
// `pairs` are ranks of candidates for `k` counted neighbors.
KERNEL broken_planes(int64_t num_points, int64_t num_rows, int64_t k, int64_t num_pairs,
                     int64_t num_constants, Floats points, Ints indices, Flagged mask, Floats noise,
                     Floats normals, Longs pairs, Floats numbers, float* voted,
                     float* voted_offsets, float* meeting, float* meeting_offsets,
                     float* deviations) {
  if (4 * num_constants != sizeof(Constants)) return TOO_WIDE;
  Constants constants;
  __builtin_memcpy(&constants, numbers, sizeof constants);
  const float turns = constants.num_alternations;
  if (!(turns >= 1 && turns < MAX_WIDTH && constants.num_refits < MAX_WIDTH)) return TOO_WIDE;
  const Lists lists = {num_points, num_rows, k, points, indices, mask};
  bool inside = true;
  const int64_t status =
      visit_patches(lists, nullptr, num_rows, [&](int64_t, int64_t i, Patch& patch) {
        const int count = compact(patch);
        for (int64_t rank = 0; rank < 2 * num_pairs; rank++)
          inside &= pairs[rank] >= 0 && pairs[rank] < count;
        if (!inside) return;
        const Plane plane =
            vote(patch, patch.weight, noise[i], normals + 3 * i, pairs, num_pairs, constants);
        const Meeting found = meet(patch, plane, noise[i], count, pairs, num_pairs, constants);
        write(plane, voted, i), write(found.plane, meeting, i);
        voted_offsets[i] = plane.offset, meeting_offsets[i] = found.plane.offset;
        deviations[i] = found.deviation;
      });
  return inside ? status : int64_t(NO_SUCH_ROW);
}
