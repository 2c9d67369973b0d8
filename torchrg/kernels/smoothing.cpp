// Smoothing passes over the planes of a neighborhood (torchrg/normals/consensus/smoothing.py), and
// paraboloids (torchrg/normals/jet.py).
#include "patches.h"

namespace {

// Table rows (8): point, normal, offset and one number per point.
constexpr int ROW = 8, NORMAL = 3, OFFSET = 6, NUMBER = 7;

struct Table {
  VectorColumns points, normals;
  Column offsets, numbers;
};

// Gathers the table rows of neighbors.
INLINE void gather_near(Floats table, const Lists& lists, const Rows& rows, Table& near) {
  Column* columns[ROW] = {&near.points.columns[0],
                          &near.points.columns[1],
                          &near.points.columns[2],
                          &near.normals.columns[0],
                          &near.normals.columns[1],
                          &near.normals.columns[2],
                          &near.offsets,
                          &near.numbers};
  for (int half = 0; half < LANES; half += 4)
    for (int j = 0; j < lists.k; j++)
      for (int column = 0; column < ROW; column += 4) {
        FourFloats found[4];
        gather_four<4>(table + column, ROW, lists.indices, lists.k, rows.numbers + half, j, found);
        for (int i = 0; i < 4; i++) columns[column + i]->set_half(j, half, found[i]);
      }
}

INLINE Planes read_planes(Floats table, const Rows& rows) {
  return {rows.vectors(table, ROW, NORMAL), rows.of(table, ROW, OFFSET)};
}

}  // namespace

// smoothing._smooth_rows: normals and offsets of rows; the table's numbers are errors.
KERNEL smooth_planes(int64_t num_points, int64_t k, int64_t num_rows, Floats table, Ints indices,
                     Flagged mask, Floats noise, Longs rows, double agreement, double reach,
                     double falloff, double ridge, double max_tilt, float* normals,
                     float* offsets) {
  const Lists lists = {num_points, num_points, k, nullptr, indices, mask};
  Table near;
  Column weights, signs;
  const int width = int(k);
  const float sq_agreement = float(agreement * agreement);
  return visit_rows(lists, rows, num_rows, [&](const Rows& eight) {
    gather_near(table, lists, eight, near);
    const Planes input = read_planes(table, eight);
    const Lanes sq_first = near.numbers[0] * near.numbers[0];
    const Vectors first = near.points[0];
    Lanes sq_radius{};
    for (int j = 0; j < width; j++) {
      const Vectors arm = near.points[j] - first;
      near.points.set(j, arm), sq_radius = larger(sq_radius, dot(arm, arm));
    }
    const Lanes far = or_one(sq_radius), radius = roots_of(far);
    const Lanes within = float(reach) * eight.of(noise);
    const Sums<9> s = add_up<9>(width, [&](int j, Lanes* sum) {
      const Vectors arm = near.points[j], normal = near.normals[j];
      const Lanes sq_error = near.numbers[j] * near.numbers[j];
      const Lanes cosine = dot(normal, input.normal);
      const Lanes residual = -dot(normal, arm) - near.offsets[j], ratio = residual / within;
      const Lanes sq_angle = sq_agreement * (sq_error + sq_first);
      Lanes weight = positive(1 - 2 * (1 - magnitude(cosine)) / sq_angle);
      weight *= weight, weight *= sq_first / sq_error;
      weight *= positive(1 - ratio * ratio);
      weight *= 1 - float(falloff) * dot(arm, arm) / far;
      if (mask) weight = where(eight.flags(mask, k, j), weight, all(0));
      const Vectors unit = arm / radius, scaled = weight * unit;
      near.points.set(j, unit), near.offsets.set(j, residual);
      weights.set(j, weight), signs.set(j, side_where(cosine >= 0));
      add(scaled, sum);
      sum[3] += scaled.x * unit.x, sum[4] += scaled.x * unit.y, sum[5] += scaled.x * unit.z;
      sum[6] += scaled.y * unit.y, sum[7] += scaled.y * unit.z, sum[8] += scaled.z * unit.z;
    });
    // smoothing._recenter_weights: Cramer's rule for the tilt that moves the mean to the point.
    const Lanes added = float(ridge) * (s[3] + s[6] + s[8]);
    const Lanes xx = s[3] + added, xy = s[4], xz = s[5];
    const Lanes yy = s[6] + added, yz = s[7], zz = s[8] + added;
    const Lanes d = yy * zz - yz * yz, e = xz * yz - xy * zz, f = xy * yz - xz * yy;
    const Lanes g = xx * zz - xz * xz, h = xy * xz - xx * yz, l = xx * yy - xy * xy;
    const Lanes determinant = xx * d + xy * e + xz * f;
    const Lanes inverse = where(determinant > 0, 1 / determinant, all(0));
    const Vectors tilt =
        inverse * Vectors{d * s[0] + e * s[1] + f * s[2], e * s[0] + g * s[1] + h * s[2],
                          f * s[0] + h * s[1] + l * s[2]};
    const Sums<5> sums = add_up<5>(width, [&](int j, Lanes* sum) {
      const Lanes t =
          larger(smaller(dot(near.points[j], tilt), all(float(max_tilt))), all(-float(max_tilt)));
      const Lanes weight = weights[j] * (1 - t), turned = weight * signs[j];
      add(turned * near.normals[j], sum);
      sum[3] += turned * near.offsets[j], sum[4] += weight;
    });
    const Vectors normal = {sums[0], sums[1], sums[2]};
    const Lanes length = roots_of(dot(normal, normal));
    const Planes smoothed = {normal / length, -sums[3] / sums[4]};
    choose(length > 0, smoothed, input).write(eight, normals, offsets);
  });
}

// smoothing._best_neighbor_planes: the best plane among every `step`-th neighbor.
KERNEL choose_planes(int64_t num_points, int64_t k, int64_t num_rows, Floats table, Ints indices,
                     Flagged mask, Floats points, Longs rows, int64_t step, double vote_reach,
                     double vote_falloff, double inlier_reach, double cost, float* normals,
                     float* offsets) {
  if (step < 1) return TOO_WIDE;
  const Lists lists = {num_points, num_points, k, points, indices, mask};
  Column weights;
  return visit_patches(lists, rows, num_rows, [&](const Rows& eight, const Patch& patch) {
    const Lanes far = or_one(farthest(patch, patch.weight));
    const Lanes sum = sum_of(patch.width, [&](int j) {
      const Lanes near = float(vote_falloff) * dot(patch[j], patch[j]) / far;
      const Lanes weight = (1 - near) * patch.weight[j];
      weights.set(j, weight);
      return weight;
    });
    const Lanes noise = eight.of(table, ROW, NUMBER), within = float(vote_reach) * noise;
    Planes best = read_planes(table, eight);
    Lanes highest = all(-INFINITE);
    const Vectors first = eight.neighbors(indices, k, 0).vectors(table, ROW);
    for (int64_t rank = 0; rank < k; rank += step) {
      const Rows neighbors = eight.neighbors(indices, k, rank);
      Planes other = read_planes(table, neighbors);
      other.offset += dot(other.normal, neighbors.vectors(table, ROW) - first);
      const Lanes shift = other.offset / noise;
      const Lanes voted = support(patch, weights, {other.normal / within, other.offset / within});
      const Lanes score = voted / sum - float(cost) * shift * shift;
      const Flags is_better = (magnitude(shift) < float(inlier_reach)) &
                              (dot(other.normal, other.normal) > 0) & (score > highest);
      highest = where(is_better, score, highest);
      best = choose(is_better, other, best);
    }
    best.write(eight, normals, offsets);
  });
}

// smoothing._inliers: number and covariance eigenvalues of the inliers of planes.
KERNEL inliers(int64_t num_points, int64_t k, int64_t num_rows, Floats points, Ints indices,
               Flagged mask, Floats normals, Floats offsets, Floats noise, Longs rows, double reach,
               float* count, float* values) {
  const Lists lists = {num_points, num_points, k, points, indices, mask};
  Column weights;
  return visit_patches(lists, rows, num_rows, [&](const Rows& eight, const Patch& patch) {
    const Planes planes = planes_of(eight, normals, offsets);
    const Lanes limit = float(reach) * eight.of(noise);
    for (int j = 0; j < patch.width; j++)
      weights.set(j,
                  where(magnitude(planes.residuals(patch, j)) <= limit, patch.weight[j], all(0)));
    const Fits fitted = fit_planes(patch, weights, patch.width);
    eight.write(fitted.count, count);
    eight.write(Vectors{fitted.low, fitted.middle, fitted.high}, values);
  });
}

// torchrg.normals.jet.fit_paraboloids of the neighborhoods of rows.
KERNEL fit_paraboloids(int64_t num_points, int64_t k, int64_t num_rows, Floats points, Ints indices,
                       Flagged mask, Floats normals, Longs rows, double flat_pivot, float* tilted,
                       float* offsets, float* deviations) {
  constexpr int TERMS = 6, COUNT = 28;
  const Lists lists = {num_points, num_points, k, points, indices, mask};
  Column us, vs, heights;
  return visit_patches(lists, rows, num_rows, [&](const Rows& eight, const Patch& patch) {
    const Lanes radius = roots_of(farthest(patch, patch.weight));
    const Lanes scale = where(radius > 0, 1 / radius, all(0));
    const Vectors normal = eight.vectors(normals);
    const Lanes x = normal.x, y = normal.y, z = normal.z;
    const Lanes sign = side_where(~(z < 0)), a = -1 / (sign + z), b = x * y * a;
    const Vectors first = {1 + sign * x * x * a, sign * b, -sign * x};
    const Vectors second = {b, sign + y * y * a, -y};
    // The sums of products of terms, of terms and heights, and of weights.
    const Sums<COUNT> sums = add_up<COUNT>(patch.width, [&](int j, Lanes* sum) {
      const Lanes weight = patch.weight[j], scaled = weight * scale;
      const Lanes u = dot(patch[j], first) * scaled, v = dot(patch[j], second) * scaled;
      const Lanes height = dot(patch[j], normal) * scaled;
      us.set(j, u), vs.set(j, v), heights.set(j, height);
      const Lanes terms[TERMS] = {weight, u, v, u * u, u * v, v * v};
      for (int p = 0; p < TERMS; p++) {
        for (int r = p; r < TERMS; r++) *sum++ += terms[p] * terms[r];
        *sum++ += terms[p] * height;
      }
      *sum += weight;
    });
    // jet._solve: L D L^T; a term without a pivot is zero.
    Lanes lower[TERMS][TERMS], right[TERMS], inverse[TERMS], solution[TERMS];
    const Lanes* sum = sums.sums;
    for (int j = 0; j < TERMS; j++) {
      Lanes column[TERMS];
      for (int r = j; r < TERMS; r++) column[r] = *sum++;
      right[j] = *sum++;
      const Lanes whole = column[j];
      for (int p = 0; p < j; p++)
        for (int r = j; r < TERMS; r++) column[r] -= lower[r][p] * (lower[j][p] * inverse[p]);
      inverse[j] = where(column[j] > float(flat_pivot) * whole, 1 / column[j], all(0));
      for (int r = j; r < TERMS; r++) lower[r][j] = column[r];
    }
    for (int j = 0; j < TERMS; j++) {
      Lanes value = right[j];
      for (int p = 0; p < j; p++) value -= lower[j][p] * solution[p];
      solution[j] = value * inverse[j];
    }
    for (int j = TERMS - 1; j >= 0; j--)
      for (int p = j + 1; p < TERMS; p++) solution[j] -= lower[p][j] * inverse[j] * solution[p];
    const Lanes square = sum_of(patch.width, [&](int j) {
      const Lanes u = us[j], v = vs[j];
      Lanes residual = heights[j] - patch.weight[j] * solution[0];
      residual -= u * solution[1], residual -= v * solution[2], residual -= u * u * solution[3];
      residual -= u * v * solution[4], residual -= v * v * solution[5];
      return residual * residual;
    });
    const Lanes freedom = larger(*sum - TERMS, all(1));
    eight.write(roots_of(square / freedom) * radius, deviations);
    const Lanes slope_u = solution[1], slope_v = solution[2];
    const Lanes length = roots_of(1 + slope_u * slope_u + slope_v * slope_v);
    eight.write((normal - slope_u * first - slope_v * second) / length, tilted);
    eight.write(solution[0] * radius / length, offsets);
  });
}
