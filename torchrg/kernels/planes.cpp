// Planes of neighbourhoods by least squares: torchrg/normals/pca.py, and the noise about them.
#include "plain.h"

// torchrg.normals.pca.fit_normals_pca of lists of rows. Patches as narrow as their covariance's own
// rounding are flagged and left to the definition, which looks at them again.
KERNEL fit_normals_pca(int64_t num_points, int64_t num_rows, int64_t k, Floats points, Ints indices,
                       Flagged mask, Floats resolution, double tolerance, double narrow_share,
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
    narrow[i] = !(width >= float(narrow_share) * length);
    valid[i] = width > larger(float(tolerance) * length, resolution[i]);
    write(valid[i] ? plane : Plane{}, normals, i);
    curvature[i] = valid[i] ? smaller(low / (sum > 0 ? sum : 1), 1 / 3.0f) : 0;
    residual_rms[i] = valid[i] ? square_root(low) : 0;
  });
}

namespace {

// torchrg.normals.consensus.noise._small_deviations: of the first neighbours from their own plane.
INLINE float of_few(const Patch& patch, int count, float breadth) {
  alignas(32) float weights[MOST], inside[MOST];
  const int width = padded(count);
  for (int j = 0; j < width; j++) inside[j] = j < count, weights[j] = inside[j] * patch.weight[j];
  if (weights[count - 1] == 0) return INFINITE;
  const Plane plane = fit_plane(patch, weights, width);
  if (!(float(plane.middle) > breadth * float(plane.high))) return INFINITE;
  Lanes squares{};
  for (int j = 0; j < width; j += LANES) {
    const Lanes rest = plane.residuals(patch, j);
    squares += rest * rest * load(inside + j);
  }
  return square_root(total(squares) / float(count - 3));
}

}  // namespace

// What torchrg.normals.consensus.noise.survey_noise takes from each neighbourhood: _deviations, and
// the deviations of the `few` and the `more` nearest ones.
KERNEL survey(int64_t num_points, int64_t num_rows, int64_t k, Floats points, Ints indices,
              Flagged mask, Floats normals, Flagged valid, int64_t few, int64_t more,
              double kurtosis, double breadth, float* offsets, float* radius, float* whole,
              bool* layered, bool* again, float* of_fewer, float* of_more) {
  if (few < 4 || more < 4) return TOO_WIDE;
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
      const Lanes rest = patch.along(a, b, c, j) - offsets[i];
      const Lanes square = rest * rest * load(patch.weight + j);
      second += square, fourth += square * square;
    }
    const float s2 = total(second), s4 = total(fourth);
    radius[i] = square_root(farthest(patch, patch.weight));
    whole[i] = valid[i] && count > 3 ? square_root(s2 / larger(count - 3, 1.0f)) : INFINITE;
    layered[i] = s4 * count < float(kurtosis) * s2 * s2 && is_finite(whole[i]);
    of_fewer[i] = few <= k ? of_few(patch, int(few), float(breadth)) : INFINITE;
    of_more[i] = more <= k ? of_few(patch, int(more), float(breadth)) : INFINITE;
  });
}
