// Inner loops of consensus normals: eight neighborhoods, one per lane, stay in the cache for all of
// their steps. See torchrg/normals/consensus/ for definitions.
#include "patches.h"

namespace {

// Constants of torchrg/normals/consensus/constants.py, in the order passed.
struct Constants {
  float vote_reach, vote_falloff, fit_reach, fit_falloff, gap, corner_limit, corner_fraction;
  float num_refits, num_alternations, minimum;
};

// Ranks of the neighbors that span candidates, two per candidate.
struct Pairs {
  Longs ranks;
  int64_t num;
};

struct Meeting : Planes {
  Lanes deviation;
};
INLINE Meeting choose(Flags flags, const Meeting& a, const Meeting& b) {
  const Planes &one = a, &other = b;
  return {choose(flags, one, other), where(flags, a.deviation, b.deviation)};
}

// hypotheses._refit
void refit(const Patch& patch, const Column& weights, Lanes reach, bool bisquare, Planes& planes) {
  Column voted_weights;
  for (int j = 0; j < patch.width; j++) {
    const Lanes residual = planes.residuals(patch, j) / reach;
    Lanes near = positive(1 - residual * residual);
    if (bisquare) near *= near;
    voted_weights.set(j, weights[j] * near);
  }
  const Fits fitted = fit_planes(patch, voted_weights, patch.width);
  planes = choose(fitted.middle > 1e-6f * fitted.high, fitted, planes);
}

// hypotheses.vote_planes
Planes vote(const Patch& patch, const Column& counted, Lanes noise, const Vectors& start,
            const Pairs& pairs, const Constants& constants) {
  Column weights, nearness;
  const Lanes far = or_one(farthest(patch, counted));
  for (int j = 0; j < patch.width; j++) {
    const Lanes near = dot(patch[j], patch[j]) / far;
    nearness.set(j, near), weights.set(j, (1 - constants.vote_falloff * near) * counted[j]);
  }
  const Lanes reach = constants.vote_reach * noise;
  Planes planes = {start};
  Lanes best = support(patch, weights, {start / reach});
  for (int64_t pair = 0; pair < pairs.num; pair++) {
    const Vectors p = patch[int(pairs.ranks[2 * pair])], q = patch[int(pairs.ranks[2 * pair + 1])];
    const Vectors product = {p.y * q.z - p.z * q.y, p.z * q.x - p.x * q.z, p.x * q.y - p.y * q.x};
    const Lanes sq_area = dot(product, product);
    const Vectors normal = product / roots_of(sq_area);
    const Lanes score = support(patch, weights, {normal / reach});
    const Flags is_better = (sq_area > 0) & (score > best);
    best = where(is_better, score, best);
    planes = choose(is_better, {normal}, planes);
  }
  for (int i = 0; i < constants.num_refits; i++) refit(patch, weights, reach, false, planes);
  for (int j = 0; j < patch.width; j++)
    weights.set(j, (1 - constants.fit_falloff * nearness[j]) * counted[j]);
  for (int i = 0; i < constants.num_refits; i++)
    refit(patch, weights, constants.fit_reach * noise, true, planes);
  return planes;
}

// hypotheses._off_surface: the points off a surface, on its more populated side.
INLINE void beyond(const Column& distances, int width, Lanes gap, Column& flags) {
  Lanes balance{};
  for (int j = 0; j < width; j++)
    balance += one_where(distances[j] > gap) - one_where(distances[j] < -gap);
  const Lanes sign = side_where(balance >= 0);
  for (int j = 0; j < width; j++) flags.set(j, one_where(distances[j] * sign > gap));
}

INLINE Lanes near(const Planes& planes, const Patch& patch, int j, Lanes gap) {
  return one_where(magnitude(planes.residuals(patch, j)) <= gap);
}

// hypotheses.fit_wedges, or fit_corners with a third group of points. Alternates between planes and
// their points; returns the points of each plane and signed distances to the surface.
template <bool is_corner>
Meeting alternate(const Patch& patch, Column& first, Column& second, Column& third, Column& outer,
                  const Constants& constants) {
  Column r, s, t;
  const int width = patch.width;
  Flags present = ~Flags{};
  Lanes cuts{};
  Fits one, other, last;
  const auto check = [&](Lanes a, Lanes b, Lanes c) {
    const Lanes fewest = is_corner ? smaller(smaller(a, b), c) : smaller(a, b);
    present = present & (fewest >= constants.minimum);
  };
  for (int turn = 0; turn < constants.num_alternations; turn++) {
    one = fit_planes(patch, first, width), other = fit_planes(patch, second, width);
    if (is_corner) last = fit_planes(patch, third, width);
    check(one.count, other.count, last.count);
    const Sums<3> inside = add_up<3>(width, [&](int j, Lanes* sums) {
      const Lanes e = one.residuals(patch, j), f = other.residuals(patch, j);
      r.set(j, e), s.set(j, f), sums[0] += e * second[j], sums[1] += f * first[j];
      if (!is_corner) return;
      const Lanes g = last.residuals(patch, j);
      t.set(j, g), sums[2] += g * (first[j] + second[j]);
    });
    const Lanes u = side_where(inside[0] >= 0), v = side_where(inside[1] >= 0),
                w = side_where(inside[2] >= 0);
    if (is_corner && turn == 0) {
      const Lanes cut =
          sum_of(width, [&](int j) { return smaller(r[j] * u, s[j] * v) * third[j]; });
      cuts = side_where(cut >= 0);
    }
    Flags same = ~Flags{};
    for (int j = 0; j < width; j++) {
      const Lanes e = r[j] * u, f = s[j] * v;
      Lanes of_first = one_where(f > e), distance = smaller(e, f), left = all(1);
      if (is_corner) {
        const Lanes pair = distance * cuts, added = t[j] * w, of_third = one_where(pair > added);
        distance = smaller(added, pair) * cuts, left -= of_third, of_first *= left;
        third.set(j, of_third);
      }
      const Lanes of_second = left - of_first;
      same = same & (of_first == first[j]) & (of_second == second[j]);
      outer.set(j, distance), first.set(j, of_first), second.set(j, of_second);
    }
    if (!is_any(~same)) break;  // the next turn would repeat this one
  }
  check(sum(first, width), sum(second, width), sum(third, width));
  const Lanes square = sum_of(width, [&](int j) { return outer[j] * outer[j]; });
  const float freedom = larger(float(width - (is_corner ? 9 : 6)), 1.0f);
  const Planes of_two = choose(second[0] > 0, other, one);
  return {is_corner ? choose(third[0] > 0, last, of_two) : of_two,
          where(present, roots_of(square / freedom), all(INFINITE))};
}

// Neighborhoods that two planes do not explain, their points of the first plane, and their signed
// distances to both.
struct Corners {
  Patch patch;
  Column first, outer;
  Rows rows;
};

// hypotheses.fit_meeting_planes: the best of two and of three planes.
Meeting meet(Corners& corners, const Planes& voted, const Meeting& best, Lanes noise,
             const Pairs& pairs, const Constants& constants) {
  const Patch& patch = corners.patch;
  Patch moved;
  Column &first = corners.first, &outer = corners.outer, second, third, remaining;
  const int width = moved.width = patch.width;
  const Lanes gap = constants.gap * noise, minimum = constants.corner_fraction * best.deviation;
  // Start from the two planes and the points off them.
  beyond(outer, width, gap, third);
  for (int j = 0; j < width; j++) {
    const Lanes on = 1 - third[j], is_first = first[j];
    second.set(j, (1 - is_first) * on), first.set(j, is_first * on);
  }
  const Meeting by_two = alternate<true>(patch, first, second, third, outer, constants);
  // Start from the voted plane and the plane voted by the remaining points.
  Vectors origin = patch[0];
  for (int j = width - 1; j >= 0; j--) {
    const Lanes is_near = near(voted, patch, j, gap);
    first.set(j, is_near), remaining.set(j, 1 - is_near);
    origin = where(is_near < 1, patch[j], origin);
  }
  for (int j = 0; j < width; j++) moved.set(j, patch[j] - origin);
  const Vectors start = fit_planes(moved, remaining, width).normal;
  const Planes other = vote(moved, remaining, noise, start, pairs, constants);
  for (int j = 0; j < width; j++) {
    const Lanes is_near = near(other, moved, j, gap) * remaining[j];
    second.set(j, is_near), third.set(j, remaining[j] - is_near);
  }
  const Meeting by_votes = alternate<true>(patch, first, second, third, outer, constants);
  Meeting three = choose(by_two.deviation < minimum, by_two, Meeting{best, minimum});
  three = choose(by_votes.deviation < three.deviation, by_votes, three);
  return choose(three.deviation < minimum, three, best);
}

// Moves the counted points of neighborhoods to the front; false if their numbers differ.
bool compact(Patch& patch) {
  int count = 0;
  for (int lane = 0; lane < LANES; lane++) {
    int end = 0;
    for (int j = 0; j < patch.width; j++) {
      if (patch.weight.at(j, lane) == 0) continue;
      for (Column& column : patch.columns) column.at(end, lane) = column.at(j, lane);
      patch.weight.at(end++, lane) = 1;
    }
    if (lane == 0) count = end;
    if (end != count) return false;
  }
  patch.width = count;
  return true;
}

}  // namespace

// surfaces.broken_planes: the voted plane, and the best of two or three intersecting planes.
// `pairs` are ranks of candidates among the counted neighbors, of equal number in all rows.
KERNEL broken_planes(int64_t num_points, int64_t num_rows, int64_t k, int64_t num_pairs,
                     int64_t num_constants, Floats points, Ints indices, Flagged mask, Floats noise,
                     Floats normals, Longs pairs, Floats numbers, float* voted,
                     float* voted_offsets, float* meeting, float* meeting_offsets,
                     float* deviations) {
  if (4 * num_constants != sizeof(Constants)) return TOO_WIDE;
  const Constants constants = read_as<Constants>(numbers);
  const float turns = constants.num_alternations;
  if (!(turns >= 1 && turns < MAX_WIDTH && constants.num_refits < MAX_WIDTH)) return TOO_WIDE;
  const Lists lists = {num_points, num_rows, k, points, indices, mask};
  const Pairs candidates = {pairs, num_pairs};
  Corners corners;
  Column first, second, outer;
  const auto write = [&](const Rows& rows, const Meeting& found) {
    found.write(rows, meeting, meeting_offsets), rows.write(found.deviation, deviations);
  };
  const auto finish = [&] {
    Rows& rows = corners.rows;
    const Planes by_votes = planes_of(rows, voted, voted_offsets);
    const Meeting two = {planes_of(rows, meeting, meeting_offsets), rows.of(deviations)};
    write(rows, meet(corners, by_votes, two, rows.of(noise), candidates, constants));
    rows.used = 0;
  };
  corners.rows.used = 0;
  bool inside = true;
  const int64_t status =
      visit_patches(lists, nullptr, num_rows, [&](const Rows& rows, Patch& patch) {
        if (mask) inside &= compact(patch);
        inside &= are_rows(pairs, 2 * num_pairs, patch.width);
        if (!inside) return;
        const int width = corners.patch.width = patch.width;
        const Lanes scale = rows.of(noise), gap = constants.gap * scale;
        const Vectors start = rows.vectors(normals);
        const Planes planes = vote(patch, patch.weight, scale, start, candidates, constants);
        for (int j = 0; j < width; j++)
          outer.set(j, planes.residuals(patch, j)), first.set(j, near(planes, patch, j, gap));
        beyond(outer, width, gap, second);
        const Meeting two = alternate<false>(patch, first, second, second, outer, constants);
        planes.write(rows, voted, voted_offsets), write(rows, two);
        const Flags fails = two.deviation > constants.corner_limit * scale;
        for (int lane = 0; lane < rows.used; lane++) {
          if (!fails[lane]) continue;
          const int to = corners.rows.used;
          const auto copy = [&](const Column& column, Column& copied) {
            for (int j = 0; j < width; j++) copied.at(j, to) = column.at(j, lane);
          };
          for (int axis = 0; axis < 3; axis++)
            copy(patch.columns[axis], corners.patch.columns[axis]);
          copy(first, corners.first), copy(outer, corners.outer);
          if (corners.rows.add(rows.numbers[lane])) finish();
        }
      });
  if (corners.rows.used > 0) finish();
  return inside ? status : int64_t(NO_SUCH_ROW);
}
