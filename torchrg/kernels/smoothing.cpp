// Smoothing passes over the planes of a neighborhood (torchrg/normals/consensus/smoothing.py), and
// paraboloids (torchrg/normals/jet.py).
#include "plain.h"

namespace {

// Table rows (8): point, normal, offset and one number per point.
constexpr int ROW = 8, NORMAL = 3, OFFSET = 6, NUMBER = 7;

}  // namespace

// smoothing._smooth_rows: normals and offsets of rows; the table's numbers are errors.
KERNEL smooth_planes(int64_t num_points, int64_t k, int64_t num_rows, Floats table, Ints indices,
                     Flagged mask, Floats noise, Longs rows, double agreement, double reach,
                     double falloff, double ridge, double max_tilt, float* normals,
                     float* offsets) {
  if (k < 1 || k > MAX_WIDTH) return TOO_WIDE;
  alignas(32) float x[MAX_WIDTH], y[MAX_WIDTH], z[MAX_WIDTH];
  alignas(32) float a[MAX_WIDTH], b[MAX_WIDTH], c[MAX_WIDTH];
  alignas(32) float residuals[MAX_WIDTH], errors[MAX_WIDTH], weights[MAX_WIDTH];
  const float tilt = float(max_tilt);
  for (int64_t q = 0; q < num_rows; q++) {
    const int64_t i = rows[q];
    if (i < 0 || i >= num_points) return NO_SUCH_ROW;
    const int32_t* row = indices + i * k;
    const bool* counted = mask ? mask + i * k : nullptr;
    if (!are_rows(row, k, num_points)) return NO_SUCH_ROW;
    const float *entry = table + ROW * i, *first = table + ROW * int64_t(row[0]);
    const float normal_a = entry[NORMAL], normal_b = entry[NORMAL + 1],
                normal_c = entry[NORMAL + 2];
    const float sq_first = first[NUMBER] * first[NUMBER];
    const int width = padded(int(k));
    for (int j = 0; j < width; j++) {
      const float* other = table + ROW * int64_t(row[j < k ? j : 0]);
      x[j] = other[0] - first[0], y[j] = other[1] - first[1], z[j] = other[2] - first[2];
      a[j] = other[NORMAL], b[j] = other[NORMAL + 1], c[j] = other[NORMAL + 2];
      residuals[j] = other[OFFSET], errors[j] = other[NUMBER];
      weights[j] = j < k && (!counted || counted[j]);
    }
    Lanes max_square{};
    for (int j = 0; j < width; j += LANES) {
      const Lanes u = load(x + j), v = load(y + j), w = load(z + j);
      max_square = larger(max_square, u * u + v * v + w * w);
    }
    const float sq_radius = largest(max_square);
    const float far = sq_radius > 0 ? sq_radius : 1, radius = square_root(far);
    const float within = float(reach) * noise[i], sq_agreement = float(agreement * agreement);
    Lanes s[9] = {};
    for (int j = 0; j < width; j += LANES) {
      Lanes u = load(x + j), v = load(y + j), w = load(z + j);
      const Lanes p = load(a + j), q = load(b + j), r = load(c + j), error = load(errors + j);
      const Lanes cosine = p * normal_a + q * normal_b + r * normal_c, sq_error = error * error;
      const Lanes residual = -(p * u + q * v + r * w) - load(residuals + j),
                  ratio = residual / within;
      const Lanes sq_angle = sq_agreement * (sq_error + sq_first);
      Lanes agrees = positive(1 - 2 * (1 - magnitude(cosine)) / sq_angle);
      agrees *= agrees, agrees *= sq_first / sq_error;
      agrees *= positive(1 - ratio * ratio);
      agrees *= 1 - float(falloff) * (u * u + v * v + w * w) / far;
      const Lanes weight = where(load(weights + j) > 0, agrees, all(0));
      u /= radius, v /= radius, w /= radius;
      store(x + j, u), store(y + j, v), store(z + j, w), store(residuals + j, residual);
      store(weights + j, weight), store(errors + j, where(cosine >= 0, all(1), all(-1)));
      const Lanes wu = weight * u, wv = weight * v, ww = weight * w;
      s[0] += wu, s[1] += wv, s[2] += ww, s[3] += wu * u, s[4] += wu * v, s[5] += wu * w;
      s[6] += wv * v, s[7] += wv * w, s[8] += ww * w;
    }
    // smoothing._recenter_weights: Cramer's rule for the tilt that moves the mean to the point.
    const float added = float(ridge) * (total(s[3]) + total(s[6]) + total(s[8]));
    const float xx = total(s[3]) + added, xy = total(s[4]), xz = total(s[5]);
    const float yy = total(s[6]) + added, yz = total(s[7]), zz = total(s[8]) + added;
    const float d = yy * zz - yz * yz, e = xz * yz - xy * zz, f = xy * yz - xz * yy;
    const float g = xx * zz - xz * xz, h = xy * xz - xx * yz, l = xx * yy - xy * xy;
    const float determinant = xx * d + xy * e + xz * f;
    const float inverse = determinant > 0 ? 1 / determinant : 0;
    const float mx = total(s[0]), my = total(s[1]), mz = total(s[2]);
    const float tilt_x = (d * mx + e * my + f * mz) * inverse;
    const float tilt_y = (e * mx + g * my + h * mz) * inverse;
    const float tilt_z = (f * mx + h * my + l * mz) * inverse;
    Lanes sum_a{}, sum_b{}, sum_c{}, sum_residual{}, sum_weight{};
    for (int j = 0; j < width; j += LANES) {
      Lanes t = load(x + j) * tilt_x + load(y + j) * tilt_y + load(z + j) * tilt_z;
      t = larger(smaller(t, all(tilt)), all(-tilt));
      const Lanes weight = load(weights + j) * (1 - t), turned = weight * load(errors + j);
      sum_a += turned * load(a + j), sum_b += turned * load(b + j), sum_c += turned * load(c + j);
      sum_residual += turned * load(residuals + j), sum_weight += weight;
    }
    const float na = total(sum_a), nb = total(sum_b), nc = total(sum_c);
    const float length = square_root(na * na + nb * nb + nc * nc);
    const bool found = length > 0;
    normals[3 * q] = found ? na / length : normal_a;
    normals[3 * q + 1] = found ? nb / length : normal_b;
    normals[3 * q + 2] = found ? nc / length : normal_c;
    offsets[q] = found ? -total(sum_residual) / total(sum_weight) : entry[OFFSET];
  }
  return DONE;
}

// smoothing._best_neighbor_planes: the best plane among every `step`-th neighbor.
KERNEL choose_planes(int64_t num_points, int64_t k, int64_t num_rows, Floats table, Ints indices,
                     Flagged mask, Floats points, Longs rows, int64_t step, double vote_reach,
                     double vote_falloff, double inlier_reach, double cost, float* normals,
                     float* offsets) {
  if (step < 1) return TOO_WIDE;
  const Lists lists = {num_points, num_points, k, points, indices, mask};
  alignas(32) float weights[MAX_WIDTH];
  return visit_patches(lists, rows, num_rows, [&](int64_t q, int64_t i, const Patch& patch) {
    const int32_t* row = indices + i * k;
    const float max_square = farthest(patch, patch.weight), far = max_square > 0 ? max_square : 1;
    Lanes sum{};
    for (int j = 0; j < patch.width; j += LANES) {
      const Lanes near = float(vote_falloff) * patch.sq_lengths(j) / far;
      const Lanes weight = (1 - near) * load(patch.weight + j);
      store(weights + j, weight), sum += weight;
    }
    const float noise = table[ROW * i + NUMBER], within = float(vote_reach) * noise;
    const float all_weights = total(sum);
    const float* best = table + ROW * i;
    float highest = -INFINITE, best_offset = best[OFFSET];
    for (int64_t rank = 0; rank < k; rank += step) {
      const float* other = table + ROW * int64_t(row[rank]);
      const float a = other[NORMAL], b = other[NORMAL + 1], c = other[NORMAL + 2];
      const float* first = points + 3 * int64_t(row[0]);
      const float moved = other[OFFSET] + (a * (other[0] - first[0]) + b * (other[1] - first[1]) +
                                           c * (other[2] - first[2]));
      const float shift = moved / noise;
      if (!(size_of(shift) < float(inlier_reach)) || !(a * a + b * b + c * c > 0)) continue;
      const float voted =
          support(patch, weights, a / within, b / within, c / within, moved / within);
      const float score = voted / all_weights - float(cost) * shift * shift;
      if (score > highest) highest = score, best = other, best_offset = moved;
    }
    for (int axis = 0; axis < 3; axis++) normals[3 * q + axis] = best[NORMAL + axis];
    offsets[q] = best_offset;
  });
}

// smoothing._inliers: number and covariance eigenvalues of the inliers of planes.
KERNEL inliers(int64_t num_points, int64_t k, int64_t num_rows, Floats points, Ints indices,
               Flagged mask, Floats normals, Floats offsets, Floats noise, Longs rows, double reach,
               float* count, float* values) {
  const Lists lists = {num_points, num_points, k, points, indices, mask};
  return visit_patches(lists, rows, num_rows, [&](int64_t q, int64_t i, Patch& patch) {
    Plane plane = {normals[3 * i], normals[3 * i + 1], normals[3 * i + 2], offsets[i], 0, 0, 0};
    Lanes sum{};
    for (int j = 0; j < patch.width; j += LANES) {
      const Flags near = magnitude(plane.residuals(patch, j)) <= float(reach) * noise[i];
      const Lanes weight = where(near, load(patch.weight + j), all(0));
      store(patch.weight + j, weight), sum += weight;
    }
    plane = fit_plane(patch, patch.weight, patch.width);
    count[q] = total(sum);
    values[3 * q] = float(plane.low), values[3 * q + 1] = float(plane.middle);
    values[3 * q + 2] = float(plane.high);
  });
}

// torchrg.normals.jet.fit_paraboloids of the neighborhoods of rows.
KERNEL fit_paraboloids(int64_t num_points, int64_t k, int64_t num_rows, Floats points, Ints indices,
                       Flagged mask, Floats normals, Longs rows, double flat_pivot, float* tilted,
                       float* offsets, float* deviations) {
  constexpr int TERMS = 6;
  const Lists lists = {num_points, num_points, k, points, indices, mask};
  alignas(32) float us[MAX_WIDTH], vs[MAX_WIDTH], heights[MAX_WIDTH];
  return visit_patches(lists, rows, num_rows, [&](int64_t q, int64_t i, const Patch& patch) {
    const float radius = square_root(farthest(patch, patch.weight));
    const float scale = radius > 0 ? 1 / radius : 0;
    const float x = normals[3 * i], y = normals[3 * i + 1], z = normals[3 * i + 2];
    const float sign = z < 0 ? -1 : 1, a = -1 / (sign + z), b = x * y * a;
    const float first[3] = {1 + sign * x * x * a, sign * b, -sign * x};
    const float second[3] = {b, sign + y * y * a, -y};
    Lanes sums[TERMS][TERMS] = {}, right[TERMS] = {}, number{};
    for (int j = 0; j < patch.width; j += LANES) {
      const Lanes weight = load(patch.weight + j), scaled = weight * scale;
      const Lanes u = patch.along(first[0], first[1], first[2], j) * scaled;
      const Lanes v = patch.along(second[0], second[1], second[2], j) * scaled;
      const Lanes height = patch.along(x, y, z, j) * scaled;
      store(us + j, u), store(vs + j, v), store(heights + j, height), number += weight;
      const Lanes terms[TERMS] = {weight, u, v, u * u, u * v, v * v};
      for (int p = 0; p < TERMS; p++) {
        right[p] += terms[p] * height;
        for (int r = p; r < TERMS; r++) sums[p][r] += terms[p] * terms[r];
      }
    }
    // jet._solve: L D L^T; a term without a pivot is zero.
    float lower[TERMS][TERMS], inverse[TERMS], solution[TERMS];
    for (int j = 0; j < TERMS; j++) {
      float column[TERMS];
      for (int r = j; r < TERMS; r++) column[r] = total(sums[j][r]);
      const float whole = column[j];
      for (int p = 0; p < j; p++)
        for (int r = j; r < TERMS; r++) column[r] -= lower[r][p] * (lower[j][p] * inverse[p]);
      inverse[j] = column[j] > float(flat_pivot) * whole ? 1 / column[j] : 0;
      for (int r = j; r < TERMS; r++) lower[r][j] = column[r];
    }
    for (int j = 0; j < TERMS; j++) {
      float value = total(right[j]);
      for (int p = 0; p < j; p++) value -= lower[j][p] * solution[p];
      solution[j] = value * inverse[j];
    }
    for (int j = TERMS - 1; j >= 0; j--)
      for (int p = j + 1; p < TERMS; p++) solution[j] -= lower[p][j] * inverse[j] * solution[p];
    Lanes squares{};
    for (int j = 0; j < patch.width; j += LANES) {
      const Lanes u = load(us + j), v = load(vs + j);
      Lanes residual = load(heights + j) - load(patch.weight + j) * solution[0];
      residual -= u * solution[1], residual -= v * solution[2], residual -= u * u * solution[3];
      residual -= u * v * solution[4], residual -= v * v * solution[5];
      squares += residual * residual;
    }
    const float freedom = larger(total(number) - TERMS, 1.0f);
    deviations[q] = square_root(total(squares) / freedom) * radius;
    const float slope_u = solution[1], slope_v = solution[2];
    const float length = square_root(1 + slope_u * slope_u + slope_v * slope_v);
    const float normal[3] = {x, y, z};
    for (int axis = 0; axis < 3; axis++)
      tilted[3 * q + axis] =
          (normal[axis] - slope_u * first[axis] - slope_v * second[axis]) / length;
    offsets[q] = solution[0] * radius / length;
  });
}
