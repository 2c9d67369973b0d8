// Smoothing passes over the planes of a neighborhood (torchrg/normals/consensus/smoothing.py), and
// paraboloids (torchrg/normals/jet.py).
#include "patches.h"

namespace {

// Table rows (8): point, normal, offset and one number per point.
constexpr int ROW = 8, NORMAL = 3, OFFSET = 6, NUMBER = 7;

// Gathers columns of the table rows of neighbors.
INLINE void gather_near(Floats table, const Lists& lists, const Rows& rows, Column* near) {
  for (int half = 0; half < LANES; half += 4)
    for (int j = 0; j < lists.k; j++)
      for (int column = 0; column < ROW; column += 4) {
        FourFloats found[4];
        gather_four<4>(table + column, ROW, lists.indices, lists.k, rows.numbers + half, j, found);
        for (int i = 0; i < 4; i++) near[column + i].set_half(j, half, found[i]);
      }
}

INLINE Planes own_planes(Floats table, const Rows& rows) {
  return {rows.of(table, ROW, NORMAL), rows.of(table, ROW, NORMAL + 1),
          rows.of(table, ROW, NORMAL + 2), rows.of(table, ROW, OFFSET)};
}

}  // namespace

// smoothing._smooth_rows: normals and offsets of rows; the table's numbers are errors.
KERNEL smooth_planes(int64_t num_points, int64_t k, int64_t num_rows, Floats table, Ints indices,
                     Flagged mask, Floats noise, Longs rows, double agreement, double reach,
                     double falloff, double ridge, double max_tilt, float* normals,
                     float* offsets) {
  const Lists lists = {num_points, num_points, k, nullptr, indices, mask};
  Column near[ROW], weights, signs;
  Column &x = near[0], &y = near[1], &z = near[2], &residuals = near[OFFSET];
  Column &a = near[NORMAL], &b = near[NORMAL + 1], &c = near[NORMAL + 2], &errors = near[NUMBER];
  const int width = int(k);
  const float sq_agreement = float(agreement * agreement);
  return visit_rows(lists, rows, num_rows, [&](const Rows& eight) {
    gather_near(table, lists, eight, near);
    const Planes own = own_planes(table, eight);
    const Lanes sq_first = errors[0] * errors[0], first[3] = {x[0], y[0], z[0]};
    Lanes sq_radius{};
    for (int j = 0; j < width; j++) {
      const Lanes u = x[j] - first[0], v = y[j] - first[1], w = z[j] - first[2];
      x.set(j, u), y.set(j, v), z.set(j, w);
      sq_radius = larger(sq_radius, u * u + v * v + w * w);
    }
    const Lanes far = or_one(sq_radius), radius = roots_of(far);
    const Lanes within = float(reach) * eight.of(noise);
    const Sums<9> s = add_up<9>(width, [&](int j, Lanes* sum) {
      Lanes u = x[j], v = y[j], w = z[j];
      const Lanes p = a[j], q = b[j], r = c[j], sq_error = errors[j] * errors[j];
      const Lanes cosine = own.project({p, q, r});
      const Lanes residual = -(p * u + q * v + r * w) - residuals[j], ratio = residual / within;
      const Lanes sq_angle = sq_agreement * (sq_error + sq_first);
      Lanes weight = positive(1 - 2 * (1 - magnitude(cosine)) / sq_angle);
      weight *= weight, weight *= sq_first / sq_error;
      weight *= positive(1 - ratio * ratio);
      weight *= 1 - float(falloff) * (u * u + v * v + w * w) / far;
      if (mask) weight = where(eight.flags(mask, k, j), weight, all(0));
      u /= radius, v /= radius, w /= radius;
      x.set(j, u), y.set(j, v), z.set(j, w), residuals.set(j, residual);
      weights.set(j, weight), signs.set(j, side_where(cosine >= 0));
      const Lanes wu = weight * u, wv = weight * v, ww = weight * w;
      sum[0] += wu, sum[1] += wv, sum[2] += ww, sum[3] += wu * u, sum[4] += wu * v;
      sum[5] += wu * w, sum[6] += wv * v, sum[7] += wv * w, sum[8] += ww * w;
    });
    // smoothing._recenter_weights: Cramer's rule for the tilt that moves the mean to the point.
    const Lanes added = float(ridge) * (s[3] + s[6] + s[8]);
    const Lanes xx = s[3] + added, xy = s[4], xz = s[5];
    const Lanes yy = s[6] + added, yz = s[7], zz = s[8] + added;
    const Lanes d = yy * zz - yz * yz, e = xz * yz - xy * zz, f = xy * yz - xz * yy;
    const Lanes g = xx * zz - xz * xz, h = xy * xz - xx * yz, l = xx * yy - xy * xy;
    const Lanes determinant = xx * d + xy * e + xz * f;
    const Lanes inverse = where(determinant > 0, 1 / determinant, all(0));
    const Lanes tilt_x = (d * s[0] + e * s[1] + f * s[2]) * inverse;
    const Lanes tilt_y = (e * s[0] + g * s[1] + h * s[2]) * inverse;
    const Lanes tilt_z = (f * s[0] + h * s[1] + l * s[2]) * inverse;
    const Sums<5> sums = add_up<5>(width, [&](int j, Lanes* sum) {
      Lanes t = x[j] * tilt_x + y[j] * tilt_y + z[j] * tilt_z;
      t = larger(smaller(t, all(float(max_tilt))), all(-float(max_tilt)));
      const Lanes weight = weights[j] * (1 - t), turned = weight * signs[j];
      sum[0] += turned * a[j], sum[1] += turned * b[j], sum[2] += turned * c[j];
      sum[3] += turned * residuals[j], sum[4] += weight;
    });
    const Lanes length = roots_of(sums[0] * sums[0] + sums[1] * sums[1] + sums[2] * sums[2]);
    const Planes turned = {sums[0] / length, sums[1] / length, sums[2] / length,
                           -sums[3] / sums[4]};
    choose(length > 0, turned, own).write(eight, normals, offsets);
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
    const Sums<1> sum = add_up<1>(patch.width, [&](int j, Lanes* total) {
      const Lanes near = float(vote_falloff) * patch.sq_lengths(j) / far;
      const Lanes weight = (1 - near) * patch.weight[j];
      weights.set(j, weight), *total += weight;
    });
    const Lanes noise = eight.of(table, ROW, NUMBER), within = float(vote_reach) * noise;
    Planes best = own_planes(table, eight);
    Lanes highest = all(-INFINITE), first[ROW], other[ROW];
    for (int64_t rank = 0; rank < k; rank += step) {
      const Rows neighbors = eight.neighbors(indices, k, rank);
      for (int column = 0; column < ROW; column++) {
        other[column] = neighbors.of(table, ROW, column);
        if (rank == 0) first[column] = other[column];
      }
      const Lanes a = other[NORMAL], b = other[NORMAL + 1], c = other[NORMAL + 2];
      const Lanes moved = other[OFFSET] + (a * (other[0] - first[0]) + b * (other[1] - first[1]) +
                                           c * (other[2] - first[2]));
      const Lanes shift = moved / noise;
      const Lanes voted =
          support(patch, weights, a / within, b / within, c / within, moved / within);
      const Lanes score = voted / sum[0] - float(cost) * shift * shift;
      const Flags is_better = (magnitude(shift) < float(inlier_reach)) &
                              (a * a + b * b + c * c > 0) & (score > highest);
      highest = where(is_better, score, highest);
      best = choose(is_better, Planes{a, b, c, moved}, best);
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
    eight.write(fitted.count, count), eight.write(fitted.low, values, 3, 0);
    eight.write(fitted.middle, values, 3, 1), eight.write(fitted.high, values, 3, 2);
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
    const Lanes x = eight.of(normals, 3, 0), y = eight.of(normals, 3, 1),
                z = eight.of(normals, 3, 2);
    const Lanes sign = side_where(~(z < 0)), a = -1 / (sign + z), b = x * y * a;
    const Lanes first[3] = {1 + sign * x * x * a, sign * b, -sign * x};
    const Lanes second[3] = {b, sign + y * y * a, -y};
    // The sums of products of terms, of terms and heights, and of weights.
    const Sums<COUNT> sums = add_up<COUNT>(patch.width, [&](int j, Lanes* sum) {
      const Lanes weight = patch.weight[j], scaled = weight * scale;
      const Lanes u = patch.along(first[0], first[1], first[2], j) * scaled;
      const Lanes v = patch.along(second[0], second[1], second[2], j) * scaled;
      const Lanes height = patch.along(x, y, z, j) * scaled;
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
    const Sums<1> squares = add_up<1>(patch.width, [&](int j, Lanes* total) {
      const Lanes u = us[j], v = vs[j];
      Lanes residual = heights[j] - patch.weight[j] * solution[0];
      residual -= u * solution[1], residual -= v * solution[2], residual -= u * u * solution[3];
      residual -= u * v * solution[4], residual -= v * v * solution[5];
      *total += residual * residual;
    });
    const Lanes freedom = larger(*sum - TERMS, all(1));
    eight.write(roots_of(squares[0] / freedom) * radius, deviations);
    const Lanes slope_u = solution[1], slope_v = solution[2];
    const Lanes length = roots_of(1 + slope_u * slope_u + slope_v * slope_v);
    const Lanes normal[3] = {x, y, z};
    for (int axis = 0; axis < 3; axis++)
      eight.write((normal[axis] - slope_u * first[axis] - slope_v * second[axis]) / length, tilted,
                  3, axis);
    eight.write(solution[0] * radius / length, offsets);
  });
}
