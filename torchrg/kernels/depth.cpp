// Planes at the pixels of a depth image: torchrg/depth/windows.py, normals.py and growth.py.
//
// Images are float64, row by row; a kernel with `from` and `to` processes only these rows.
#include "plain.h"

namespace {

typedef const double* Doubles;

constexpr int REACH = 2, SIDE = 5, NUM_SIZES = 4, MOMENTS = 10, COLUMNS = 9;
constexpr int TILE = 128, WIDE = TILE + 2 * REACH;  // columns fitted together
constexpr int BROAD = 640;                          // columns described together
constexpr int LONG = 9, SHORT = 3;                  // sides of narrow windows in pixels
constexpr double FLAT = 1.35, SELF_REACH = 3.5, SAME_NOISE = 2, MIN_QUARTERS = 0.7;
constexpr double BEND = 0.005, MAX_BEND = 0.03, STEEPEST = 4;
constexpr double NONE = __builtin_inf();

INLINE double square(double value) { return value * value; }

INLINE bool are_rows_of(int64_t from, int64_t to, int64_t height) {
  return from >= 0 && from <= to && to <= height && from % 2 == 0;
}

// windows._planes_from_sums: slopes, origin, deviation and mean of window j.
template <int N>
INLINE void solve(const double (&s)[MOMENTS][N], int j, double min_count, double min_spread,
                  double (&to)[5][N]) {
  const double count = s[0][j], inverse = 1 / larger(count, 1.0);
  const double u = s[1][j] * inverse, v = s[2][j] * inverse, w = s[3][j] * inverse;
  const double uu = s[4][j] * inverse - u * u, uv = s[5][j] * inverse - u * v,
               vv = s[6][j] * inverse - v * v, uw = s[7][j] * inverse - u * w,
               vw = s[8][j] * inverse - v * w, ww = s[9][j] * inverse - w * w;
  const double determinant = uu * vv - uv * uv;
  const bool has_plane = (count >= min_count) & (determinant > min_spread);
  const double spread = has_plane ? determinant : 1;
  const double u_slope = (vv * uw - uv * vw) / spread, v_slope = (uu * vw - uv * uw) / spread;
  const double residual = ww - u_slope * uw - v_slope * vw;
  const double variance = (residual < 0 ? 0 : residual) * count / larger(count - 3, 1.0);
  to[0][j] = u_slope, to[1][j] = v_slope, to[2][j] = w - u_slope * u - v_slope * v;
  to[3][j] = has_plane & (variance < NONE) ? square_root(variance) : NONE, to[4][j] = w;
}

// Contribution of a pixel to the sums of its windows; `value` is 0 unless it counts one.
INLINE void find_moments(double one, double u, double v, double value, double (&to)[MOMENTS]) {
  const double mu = one * u, mv = one * v;
  to[0] = one, to[1] = mu, to[2] = mv, to[3] = value, to[4] = mu * u, to[5] = mu * v;
  to[6] = mv * v, to[7] = value * u, to[8] = value * v, to[9] = value * value;
}

// Fits planes (5, h, w) to the windows around cells, and sums these to cells of twice the width.
// `read` prepares a row of the columns of a tile, `add` adds the moments of such rows.
template <class Read, class Add>
INLINE int64_t fit_all(int64_t h, int64_t w, int64_t from, int64_t to, double min_count,
                       double min_spread, double* planes, double* coarse, Read read, Add add) {
  alignas(32) double down[MOMENTS][WIDE], sums[MOMENTS][TILE], solved[5][TILE];
  const int64_t coarse_w = (w + 1) / 2, coarse_size = (h + 1) / 2 * coarse_w;
  for (int64_t left = 0; left < w; left += TILE) {
    const int width = int(smaller(int64_t(TILE), w - left));
    for (int64_t row = from - REACH; row < to + REACH; row++) {
      read(row, left);
      const int64_t i = row - REACH;
      if (i < from) continue;
      if (i % 2 == 0) {
        const int64_t rows[] = {i, i + 1};
        add(rows, left, down);
        for (int m = 0; m < MOMENTS; m++) {
          double* cells = coarse + m * coarse_size + i / 2 * coarse_w + left / 2;
          for (int j = 0; j < (width + 1) / 2; j++)
            cells[j] = down[m][2 * j + REACH] + down[m][2 * j + 1 + REACH];
        }
      }
      const int64_t rows[] = {i, i - 1, i + 1, i - 2, i + 2};
      add(rows, left, down);
      for (int m = 0; m < MOMENTS; m++)
        for (int j = 0; j < TILE; j++)
          sums[m][j] =
              down[m][j + 2] + down[m][j + 1] + down[m][j + 3] + down[m][j] + down[m][j + 4];
      for (int j = 0; j < TILE; j++) solve(sums, j, min_count, min_spread, solved);
      for (int part = 0; part < 5; part++)
        __builtin_memcpy(planes + (part * h + i) * w + left, solved[part], width * sizeof(double));
    }
  }
  return DONE;
}

// windows.WindowNoise
struct Noise {
  double factor, constant, growth, rounding;
  INLINE_MEMBER double at(double w) const {
    const double lowest = rounding * w;
    return larger(factor * larger(growth + constant * (w * w), lowest), lowest);
  }
};

// Fit of a window: see windows.WindowPlanes.
enum Column { U_SLOPE, V_SLOPE, ORIGIN, DEVIATION, MEAN, NOISE, TOLERANCE, STRONGEST, RELATIVE };

struct Window {
  const double* numbers;  // one per column, `step` apart
  int64_t step;
  double rows, columns;
  int64_t cell, across, wide;  // its center cell; pixels and cells per row

  INLINE_MEMBER double operator[](Column column) const { return numbers[column * step]; }
  INLINE_MEMBER bool holds(int64_t r, int64_t c) const {
    const double row = double(cell / across * wide) + double(wide - 1) / 2,
                 column = double(cell % across * wide) + double(wide - 1) / 2;
    return size_of(double(r) - row) <= rows / 2 && size_of(double(c) - column) <= columns / 2;
  }
};

// The windows of an image: squares of all sizes, then n horizontal and n vertical ones.
struct Windows {
  int64_t width, first[NUM_SIZES + 1], columns[NUM_SIZES], n;
  const double *squares, *narrow;
  const int64_t* pixels;

  Windows(int64_t h, int64_t w, int64_t n, Doubles squares, Doubles narrow, Longs pixels)
      : width(w), n(n), squares(squares), narrow(narrow), pixels(pixels) {
    first[0] = 0;
    for (int k = 0; k < NUM_SIZES; k++, h = (h + 1) / 2, w = (w + 1) / 2)
      first[k + 1] = first[k] + h * w, columns[k] = w;
  }
  INLINE_MEMBER Window operator[](int64_t k) const {
    int size = 0;
    while (size < NUM_SIZES && k >= first[size + 1]) size++;
    const int64_t cell = k - first[size];
    if (size == NUM_SIZES) {
      const double tall = cell < n ? SHORT : LONG, wide = cell < n ? LONG : SHORT;
      return {narrow + cell, 2 * n, tall, wide, pixels[cell % n], width, 1};
    }
    const int64_t cells = first[size + 1] - first[size], wide = int64_t(1) << size;
    const double side = double(SIDE * wide);
    return {squares + COLUMNS * first[size] + cell, cells, side, side, cell, columns[size], wide};
  }
  INLINE_MEMBER bool has(int64_t k) const { return k >= 0 && k < first[NUM_SIZES] + 2 * n; }
};

INLINE double sq_slope_noise(const Window& window, double tolerance) {
  const double rows = window.rows, columns = window.columns;
  return 6 * square(tolerance) * (1 / (rows * rows) + 1 / (columns * columns)) / (rows * columns);
}

}  // namespace

// windows.fit_windows around pixels; `coarse` (10, p, q) receives the cells of 2 pixels.
KERNEL fit_pixel_windows(int64_t h, int64_t w, int64_t m, int64_t p, int64_t q, Doubles values,
                         Flagged seen, Doubles u, Doubles v, double* planes, double* coarse,
                         double min_count, double min_spread, int64_t from, int64_t to) {
  if (m != MOMENTS || p != (h + 1) / 2 || q != (w + 1) / 2 || !are_rows_of(from, to, h))
    return TOO_WIDE;
  alignas(32) double ones[SIDE][WIDE], weighted[SIDE][WIDE], across[WIDE], along[SIDE];
  return fit_all(
      h, w, from, to, min_count, min_spread, planes, coarse,
      [&](int64_t row, int64_t left) {
        auto &one = ones[(row + SIDE) % SIDE], &value = weighted[(row + SIDE) % SIDE];
        const bool is_inside = row >= 0 && row < h;
        along[(row + SIDE) % SIDE] = is_inside ? v[row] : 0;
        for (int k = 0; k < WIDE; k++) {
          const int64_t c = left + k - REACH;
          const bool counts = is_inside && c >= 0 && c < w && seen[row * w + c];
          one[k] = counts, value[k] = counts ? values[row * w + c] : 0;
          across[k] = c >= 0 && c < w ? u[c] : 0;
        }
      },
      [&](const auto& rows, int64_t, double (&down)[MOMENTS][WIDE]) {
        constexpr int COUNT = sizeof rows / sizeof *rows;
        for (int k = 0; k < WIDE; k++) {
          double total[MOMENTS], terms[MOMENTS];
          for (int t = 0; t < COUNT; t++) {
            const int at = int((rows[t] + SIDE) % SIDE);
            find_moments(ones[at][k], across[k], along[at], weighted[at][k], terms);
            for (int m = 0; m < MOMENTS; m++) total[m] = t ? total[m] + terms[m] : terms[m];
          }
          for (int m = 0; m < MOMENTS; m++) down[m][k] = total[m];
        }
      });
}

// windows.fit_windows around larger cells.
KERNEL fit_cell_windows(int64_t m, int64_t h, int64_t w, int64_t p, int64_t q, Doubles cells,
                        double* planes, double* coarse, double min_count, double min_spread,
                        int64_t from, int64_t to) {
  if (m != MOMENTS || p != (h + 1) / 2 || q != (w + 1) / 2 || !are_rows_of(from, to, h))
    return TOO_WIDE;
  return fit_all(
      h, w, from, to, min_count, min_spread, planes, coarse, [](int64_t, int64_t) {},
      [&](const auto& rows, int64_t left, double (&down)[MOMENTS][WIDE]) {
        static const double none[WIDE] = {};
        constexpr int COUNT = sizeof rows / sizeof *rows;
        const int64_t first = larger(left - REACH, int64_t(0));
        const int count = int(smaller(left + TILE + REACH, w) - first),
                  at = int(first - left) + REACH;
        for (int m = 0; m < MOMENTS; m++) {
          const double* lines[COUNT];
          for (int t = 0; t < COUNT; t++)
            lines[t] = rows[t] < 0 || rows[t] >= h ? none : cells + (m * h + rows[t]) * w + first;
          if (count < WIDE) __builtin_memset(down[m], 0, sizeof down[m]);
          for (int k = 0; k < count; k++) {
            double total = lines[0][k];
            for (int t = 1; t < COUNT; t++) total += lines[t][k];
            down[m][at + k] = total;
          }
        }
      });
}

// normals.rate_windows: maximum deviations of windows, and whether windows or quarters exceed
// them; with masks of pixels, only of windows that may contain a seen pixel without a flat window.
KERNEL rate_windows(int64_t h, int64_t w, int64_t p, int64_t q, double* table, Doubles quarters,
                    Flagged seen, Flagged flat, double factor, double constant, double growth,
                    double rounding, double quarter_factor, double fx, double fy, double half,
                    double jitter, int64_t size, int64_t from, int64_t to) {
  constexpr int64_t BATCH = 28;  // and two on both sides
  if (!are_rows_of(from, to, h)) return TOO_WIDE;
  const Noise noise = {factor, constant, growth, rounding};
  const Noise finer = {quarter_factor, constant, growth, rounding};
  const double factor_of_quarters = 1 + SAME_NOISE / double(SIDE * size);
  double* columns[COLUMNS];
  for (int column = 0; column < COLUMNS; column++) columns[column] = table + column * h * w;
  const auto* counted = reinterpret_cast<const uint8_t*>(seen);
  const auto* taken = reinterpret_cast<const uint8_t*>(flat);
  const auto is_open = [&](int64_t i, int64_t left) {
    if (!seen || !flat) return true;
    const int64_t first = larger(left - REACH, int64_t(0)), end = smaller(left + BATCH + REACH, w);
    uint8_t open = 0;
    for (int64_t r = larger(i - REACH, int64_t(0)); r <= smaller(i + REACH, h - 1); r++)
      for (int64_t k = r * w + first; k < r * w + end; k++) open |= counted[k] & ~taken[k];
    return open > 0;
  };
  for (int64_t i = from; i < to; i++)
    for (int64_t left = 0; left < w; left += BATCH) {
      if (!is_open(i, left)) continue;
      const int64_t right = smaller(left + BATCH, w);
      for (int64_t k = i * w + left; k < i * w + right; k++) {
        const double a = columns[U_SLOPE][k], b = columns[V_SLOPE][k], c = columns[ORIGIN][k],
                     mean = columns[MEAN][k], expected = noise.at(mean);
        const double by_noise = square_root(square(expected) + square(jitter) * (a * a + b * b));
        const double nearness = square(a * fx) + square(b * fy) + c * c;
        const double straight = nearness > square(STEEPEST * mean) ? 0 : nearness;
        const double bend = mean > 0 ? half * straight / mean : 0;
        columns[NOISE][k] = by_noise, columns[TOLERANCE][k] = larger(by_noise, BEND * bend);
        columns[STRONGEST][k] = MAX_BEND * bend;
      }
      for (int64_t j = left; j < right; j++) {
        const int64_t here = i * w + j;
        const double tolerance = columns[TOLERANCE][here], deviation = columns[DEVIATION][here];
        bool is_flat = deviation / tolerance <= FLAT;
        if (p * q > 0 && is_flat) {
          double squares = 0, count = 0;
          for (int64_t k = 2 * i - 2; k <= 2 * i + 3; k += SIDE)
            for (int64_t l = 2 * j - 2; l <= 2 * j + 3; l += SIDE)
              if (k >= 0 && k < p && l >= 0 && l < q && quarters[k * q + l] < NONE)
                squares += square(quarters[k * q + l]), count += 1;
          double expected = square_root(count > 0 ? squares / count : NONE);
          expected = expected * (columns[NOISE][here] / finer.at(columns[MEAN][here]));
          is_flat = deviation <= factor_of_quarters * larger(expected, MIN_QUARTERS * tolerance);
        }
        columns[RELATIVE][here] = is_flat ? deviation / tolerance : NONE;
      }
    }
  return DONE;
}

// normals.offer_windows: the window of one size that each pixel takes, numbered from `first`.
KERNEL offer_windows(int64_t h, int64_t w, int64_t p, int64_t q, Doubles values, Flagged seen,
                     Doubles u, Doubles v, Doubles table, int64_t* windows, bool* flat, bool* edge,
                     int64_t size, int64_t first, int64_t from, int64_t to) {
  if (size < 1 || (p - 1) * size >= h || p * size < h || q * size < w || !are_rows_of(from, to, p))
    return TOO_WIDE;
  const int64_t step = p * q;
  const double *relative = table + RELATIVE * step, *tolerance = table + TOLERANCE * step;
  for (int64_t i = from; i < to; i++)
    for (int64_t j = 0; j < q; j++) {
      const int64_t here = i * q + j;
      if (size == 1 && flat[here]) continue;
      int64_t flattest = -1;  // unknown; `here` if no window is flat
      for (int64_t r = i * size; r < smaller((i + 1) * size, h); r++)
        for (int64_t c = j * size; c < smaller((j + 1) * size, w); c++) {
          const int64_t pixel = r * w + c;
          if (flat[pixel] || !seen[pixel]) continue;
          const auto is_near = [&](int64_t k, double reach) {
            const double on_plane =
                table[U_SLOPE * step + k] * u[c] + table[V_SLOPE * step + k] * v[r];
            return size_of(values[pixel] - (on_plane + table[ORIGIN * step + k])) <= reach;
          };
          int64_t taken = -1;
          if (relative[here] < NONE && is_near(here, SELF_REACH * tolerance[here])) taken = here;
          if (taken < 0 && size == 1 &&
              table[DEVIATION * step + here] <= table[STRONGEST * step + here] &&
              is_near(here, NONE))
            taken = here;
          if (taken < 0) {
            if (flattest < 0) {
              flattest = here;
              double lowest = NONE;
              for (int64_t k = larger(i - REACH, int64_t(0)); k <= smaller(i + REACH, p - 1); k++)
                for (int64_t l = larger(j - REACH, int64_t(0)); l <= smaller(j + REACH, q - 1); l++)
                  if (const int64_t at = k * q + l; relative[at] < lowest)
                    lowest = relative[at], flattest = at;
            }
            const double reach =
                larger(SELF_REACH * table[NOISE * step + flattest], tolerance[flattest]);
            if (relative[flattest] < NONE && is_near(flattest, reach))
              taken = flattest, edge[pixel] = true;
          }
          if (taken >= 0) windows[pixel] = first + taken, flat[pixel] = true;
        }
    }
  return DONE;
}

namespace {

// Calls `visit` with the rows and columns of a narrow window, horizontal (0) or vertical (1).
template <class Visit>
INLINE void visit_narrow(int64_t h, int64_t w, int64_t pixel, int shape, const Visit& visit) {
  const int64_t row = pixel / w, tall = (shape ? LONG : SHORT) / 2;
  const int64_t column = pixel % w, wide = (shape ? SHORT : LONG) / 2;
  for (int64_t r = larger(row - tall, int64_t(0)); r <= smaller(row + tall, h - 1); r++)
    for (int64_t c = larger(column - wide, int64_t(0)); c <= smaller(column + wide, w - 1); c++)
      visit(r, c);
}

}  // namespace

// windows.fit_narrow_windows, horizontal (0) and vertical (1), around numbered pixels.
KERNEL fit_narrow_windows(int64_t h, int64_t w, int64_t n, Doubles values, Doubles u, Doubles v,
                          Longs numbers, Longs pixels, double min_count, double min_spread,
                          double* planes, int64_t from, int64_t to) {
  if (!are_rows_of(from, to, n)) return TOO_WIDE;
  for (int64_t number = from; number < to; number++) {
    if (pixels[number] < 0 || pixels[number] >= h * w) return NO_SUCH_ROW;
    double sums[MOMENTS][2] = {}, terms[MOMENTS], solved[5][2];
    for (int shape = 0; shape < 2; shape++) {
      visit_narrow(h, w, pixels[number], shape, [&](int64_t r, int64_t c) {
        if (numbers[r * w + c] < 0) return;
        find_moments(1, u[c], v[r], values[r * w + c], terms);
        for (int m = 0; m < MOMENTS; m++) sums[m][shape] += terms[m];
      });
      solve(sums, shape, min_count, min_spread, solved);
      for (int part = 0; part < 5; part++)
        planes[(2 * part + shape) * n + number] = solved[part][shape];
    }
  }
  return DONE;
}

// normals.choose_narrow: the flatter narrow window around each pixel, else the flattest window that
// contains it (`adjacent`), else -1.
KERNEL choose_narrow(int64_t h, int64_t w, int64_t n, Doubles values, Doubles u, Doubles v,
                     Longs numbers, Longs pixels, Doubles table, int64_t* chosen, bool* adjacent,
                     int64_t from, int64_t to) {
  if (!are_rows_of(from, to, n)) return TOO_WIDE;
  for (int64_t number = from; number < to; number++) {
    const int64_t pixel = pixels[number];
    if (pixel < 0 || pixel >= h * w) return NO_SUCH_ROW;
    const int64_t row = pixel / w, column = pixel % w;
    const auto at = [&](Column part, int64_t k) { return table[part * 2 * n + k]; };
    const auto is_near = [&](int64_t k) {
      const double on_plane = at(U_SLOPE, k) * u[column] + at(V_SLOPE, k) * v[row];
      return size_of(values[pixel] - (on_plane + at(ORIGIN, k))) <=
             larger(SELF_REACH * at(NOISE, k), at(TOLERANCE, k));
    };
    const int64_t flatter = at(RELATIVE, n + number) < at(RELATIVE, number) ? n + number : number;
    if (at(RELATIVE, flatter) < NONE && is_near(flatter)) {
      chosen[number] = flatter, adjacent[number] = false;
      continue;
    }
    double lowest = NONE;
    int64_t flattest = 2 * n;
    bool inside = true;
    for (int shape = 0; shape < 2; shape++)
      visit_narrow(h, w, pixel, shape, [&](int64_t r, int64_t c) {
        const int64_t other = numbers[r * w + c], k = shape * n + other;
        inside &= other < n;
        if (other >= 0 && other < n && at(RELATIVE, k) < lowest && is_near(k))
          lowest = at(RELATIVE, k), flattest = k;
      });
    if (!inside) return NO_SUCH_ROW;
    adjacent[number] = flattest < 2 * n, chosen[number] = adjacent[number] ? flattest : -1;
  }
  return DONE;
}

namespace {

// Properties shared by all pixels of a window.
struct Surface {
  Window window;
  double slopes[2], origin, deviation, limit, length, normal[3];
  double variances[2];  // of the columns and rows of its pixels

  INLINE_MEMBER void look_at(const Window& seen, const double* focal) {
    window = seen, origin = window[ORIGIN], deviation = window[DEVIATION];
    limit = window[TOLERANCE], slopes[0] = window[U_SLOPE], slopes[1] = window[V_SLOPE];
    variances[0] = (window.columns * window.columns - 1) / 12;
    variances[1] = (window.rows * window.rows - 1) / 12;
    const double a = slopes[0] * focal[0], b = slopes[1] * focal[1];
    length = square_root(a * a + b * b + origin * origin), length = length > 0 ? length : 1;
    normal[0] = -a / length, normal[1] = -b / length, normal[2] = -origin / length;
  }
  INLINE_MEMBER double tolerance(double noise) const {
    return deviation > FLAT * limit ? deviation : larger(limit, noise);
  }
};

// The surfaces of adjacent pixels of a row, one for each run of pixels with one window.
struct Surfaces {
  Surface runs[BROAD + 1];
  uint16_t run[BROAD + 1];

  INLINE_MEMBER void read(const Windows& all, Longs numbers, int count, const double* focal) {
    for (int j = 0, k = -1; j < count; j++) {
      if (j == 0 || numbers[j] != numbers[j - 1]) runs[++k].look_at(all[numbers[j]], focal);
      run[j] = uint16_t(k);
    }
  }
  INLINE_MEMBER const Surface& operator[](int j) const { return runs[run[j]]; }
};

}  // namespace

// pixels.describe_pixels: noise, normals, curvature and validity from the windows of pixels, and
// whether a pixel is on the same surface as its right and lower neighbor.
KERNEL describe_pixels(int64_t h, int64_t w, int64_t N, int64_t M, int64_t n, Doubles values,
                       Flagged seen, Doubles u, Doubles v, Doubles x, Doubles y, Longs windows,
                       Flagged flat, Doubles squares, Doubles narrow, Longs pixels, double* normals,
                       double* curvature, double* noise, bool* valid, bool* right, bool* down,
                       double fx, double fy, double factor, double constant, double growth,
                       double rounding, double max_step, double max_sq_chord, double wider_sq_chord,
                       int64_t from, int64_t to) {
  const Windows all(h, w, n, squares, narrow, pixels);
  if (N != COLUMNS * all.first[NUM_SIZES] || M != COLUMNS * 2 * n || !are_rows_of(from, to, h))
    return TOO_WIDE;
  for (int64_t pixel = from * w; pixel < smaller(to + 1, h) * w; pixel++)
    if (!all.has(windows[pixel])) return NO_SUCH_ROW;
  const Noise expected = {factor, constant, growth, rounding};
  const double focal[2] = {fx, fy};
  const auto are_joined = [&](int64_t r, int64_t c, const Surface& here, const Surface& other,
                              bool is_down) {
    const int64_t there = r * w + c + (is_down ? w : 1);
    const double u_slope = here.slopes[0] - other.slopes[0],
                 v_slope = here.slopes[1] - other.slopes[1];
    const double step = u_slope * u[c] + v_slope * v[r] + here.origin - other.origin;
    const double ours = here.tolerance(noise[r * w + c]),
                 theirs = other.tolerance(expected.at(values[there]));
    const double limit = max_step * larger(ours, theirs);
    if (!(size_of(step) <= limit && size_of(step + (is_down ? v_slope : u_slope)) <= limit))
      return false;
    const double *a = here.normal, *b = other.normal;
    const double sign = __builtin_copysign(1.0, a[0] * b[0] + a[1] * b[1] + a[2] * b[2]);
    const double turned =
        square(b[0] - a[0] * sign) + square(b[1] - a[1] * sign) + square(b[2] - a[2] * sign);
    if (turned <= max_sq_chord) return true;
    return here.window.holds(r + is_down, c + !is_down) && other.window.holds(r, c) &&
           (turned <= wider_sq_chord ||
            u_slope * u_slope + v_slope * v_slope <=
                sq_slope_noise(here.window, ours) + sq_slope_noise(other.window, theirs));
  };
  alignas(32) double parts[6][BROAD];  // of the windows of pixels, for one pass without branches
  Surfaces rows[2];
  for (int64_t left = 0; left < w; left += BROAD) {
    const int width = int(smaller(int64_t(BROAD), w - left));
    const int count = width + (left + width < w);
    for (int64_t r = from; r < to; r++) {
      const int64_t first = r * w + left;
      Surfaces &row = rows[r % 2], &below = rows[(r + 1) % 2];
      if (r == from) row.read(all, windows + first, count, focal);
      if (r + 1 < h) below.read(all, windows + first + w, count, focal);
      for (int j = 0; j < width; j++) noise[first + j] = expected.at(values[first + j]);
      for (int j = 0; j < width; j++) {
        const int64_t c = left + j, pixel = first + j, number = windows[pixel];
        const Surface& here = row[j];
        right[pixel] = flat[pixel] && c + 1 < w && flat[pixel + 1] &&
                       (windows[pixel + 1] == number || are_joined(r, c, here, row[j + 1], false));
        down[pixel] = flat[pixel] && r + 1 < h && flat[pixel + w] &&
                      (windows[pixel + w] == number || are_joined(r, c, here, below[j], true));
        valid[pixel] = flat[pixel] || (seen[pixel] && here.deviation < NONE);
        for (int axis = 0; axis < 3; axis++)
          normals[3 * pixel + axis] = valid[pixel] ? here.normal[axis] : 0;
        for (int axis = 0; axis < 2; axis++)
          parts[axis][j] = here.slopes[axis], parts[2 + axis][j] = here.variances[axis];
        parts[4][j] = valid[pixel] ? here.deviation : 0, parts[5][j] = here.length;
      }
      for (int j = 0; j < width; j++) {
        const int64_t c = left + j, pixel = first + j;
        const double z = 1 / (values[pixel] > 0 ? values[pixel] : 1);
        const double ray = x[c] * x[c] + y[r] * y[r] + 1;
        const double across = square(z * parts[4][j] / parts[5][j]);
        const double u = parts[0][j] * z, v = parts[1][j] * z;
        const double along =
            parts[2][j] * (u * u * ray - 2 / fx * u * x[c] + 1 / (fx * fx)) +
            parts[3][j] * (v * v * ray - 2 / fy * v * y[r] + 1 / (fy * fy));
        const double total = across + along * z * z;
        curvature[pixel] = smaller(across / (total > 0 ? total : 1), 1.0 / 3);
      }
    }
  }
  return DONE;
}

// growth.connect_pixels: the number of the connected component of each pixel.
KERNEL connect_pixels(int64_t h, int64_t w, Flagged flat, Flagged right, Flagged down,
                      int64_t* roots) {
  const auto root_of = [&](int64_t pixel) {
    while (roots[pixel] != pixel) pixel = roots[pixel] = roots[roots[pixel]];
    return pixel;
  };
  int64_t root = -1;  // of the pixel before
  for (int64_t r = 0; r < h; r++)
    for (int64_t c = 0; c < w; c++) {
      const int64_t pixel = r * w + c, above = pixel - w;
      roots[pixel] = -1;
      if (!flat[pixel]) continue;
      if (!(c > 0 && flat[pixel - 1] && right[pixel - 1])) root = pixel;
      roots[pixel] = root;
      if (r > 0 && flat[above] && down[above] && roots[above] != root) {
        const int64_t other = root_of(above), larger_root = larger(root, other);
        root = smaller(root, other), roots[larger_root] = roots[pixel] = root;
      }
    }
  int64_t count = 0;
  for (int64_t pixel = 0; pixel < h * w; pixel++)
    if (flat[pixel]) roots[pixel] = roots[pixel] == pixel ? count++ : roots[roots[pixel]];
  return DONE;
}

namespace {

// Queue of the pixels whose label may change in a pass, without duplicates.
struct Front {
  int64_t h, w, *rows, *marks, *chosen;  // (h * w) each; marks: last pass that queued it
  int64_t count = 0, turn = 0;

  Front(int64_t h, int64_t w, int64_t* rows, int64_t* marks, int64_t* chosen)
      : h(h), w(w), rows(rows), marks(marks), chosen(chosen) {
    for (int64_t i = 0; i < h * w; i++) marks[i] = -1;
  }
  // The eight neighbors of a pixel, clamped to the image.
  template <class Visit>
  INLINE_MEMBER void visit_neighbors(int64_t pixel, const Visit& visit) const {
    const int64_t row = pixel / w, column = pixel % w;
    for (int64_t r = row - 1; r <= row + 1; r++)
      for (int64_t c = column - 1; c <= column + 1; c++)
        if (r != row || c != column)
          visit(smaller(larger(r, int64_t(0)), h - 1) * w + smaller(larger(c, int64_t(0)), w - 1));
  }
  INLINE_MEMBER void add(int64_t pixel) {
    if (marks[pixel] == turn) return;
    marks[pixel] = turn, rows[count++] = pixel;
  }
  // In each pass, pixels take the label of the neighbor with the lowest cost (ties: the smallest
  // label). Their neighbors that may change are queued for the next pass.
  template <class Cost, class Follows>
  INLINE_MEMBER void spread(int64_t* labels, int64_t num_turns, const Cost& cost,
                            const Follows& follows) {
    while (turn < num_turns && count > 0) {
      int64_t moved = 0;
      for (int64_t f = 0; f < count; f++) {
        const int64_t pixel = rows[f];
        double lowest = NONE;
        int64_t best = -1;
        visit_neighbors(pixel, [&](int64_t other) {
          const double away = cost(pixel, other);
          if (away < lowest || (away == lowest && labels[other] < best))
            lowest = away, best = labels[other];
        });
        if (best >= 0) rows[moved] = pixel, chosen[moved++] = best;
      }
      for (int64_t f = 0; f < moved; f++) labels[rows[f]] = chosen[f], chosen[f] = rows[f];
      count = 0, turn++;
      const auto add_next = [&](int64_t pixel) {
        if (follows(pixel)) add(pixel);
      };
      for (int64_t f = 0; f < moved; f++) add_next(chosen[f]), visit_neighbors(chosen[f], add_next);
    }
  }
};

// Calls `visit` with the pairs of adjacent pixels that have different labels, along rows, columns
// and diagonals.
template <class Visit>
INLINE void visit_borders(int64_t h, int64_t w, Longs labels, const Visit& visit) {
  const auto compare = [&](int64_t i, int64_t other) {
    if (labels[i] != labels[other]) visit(i, other);
  };
  for (int64_t r = 0; r < h; r++)
    for (int64_t c = 0, i = r * w; c < w; c++, i++) {
      const bool is_inside = r + 1 < h && c + 1 < w;
      if (is_inside && !((labels[i] ^ labels[i + 1]) | (labels[i] ^ labels[i + w]) |
                         (labels[i] ^ labels[i + w + 1])))
        continue;
      if (c + 1 < w) compare(i, i + 1);
      if (r + 1 < h) compare(i, i + w);
      if (is_inside) compare(i, i + w + 1), compare(i + 1, i + w);
    }
}

INLINE bool are_labels(Longs labels, int64_t n, int64_t num) {
  uint64_t wrong = 0;  // in its sign, without a branch
  for (int64_t i = 0; i < n; i++)
    wrong |= (uint64_t(labels[i]) + 1) | (uint64_t(num) - 1 - uint64_t(labels[i]));
  return int64_t(wrong) >= 0;
}

}  // namespace

// repair.assign_unlabeled for the pixels of a growth.InverseCloud.
KERNEL assign_unlabeled_pixels(int64_t h, int64_t w, int64_t M, Doubles values, Doubles x,
                               Doubles y, Flagged seen, int64_t* labels, Doubles normals,
                               Doubles centers, Doubles reach, int64_t* rows, int64_t* marks,
                               int64_t* chosen) {
  const int64_t n = h * w;
  if (!are_labels(labels, n, M)) return NO_SUCH_ROW;
  Front front(h, w, rows, marks, chosen);
  const auto may_join = [&](int64_t pixel) { return labels[pixel] < 0 && seen[pixel]; };
  for (int64_t i = 0; i < n; i++)
    if (may_join(i)) front.add(i);
  front.spread(
      labels, n,
      [&](int64_t pixel, int64_t other) {
        const int64_t m = labels[other];
        if (m < 0) return NONE;
        const double point[3] = {x[pixel % w], y[pixel / w], values[pixel]};
        double away = 0;
        for (int axis = 0; axis < 3; axis++)
          away += (point[axis] - centers[3 * m + axis]) * normals[3 * m + axis];
        return size_of(away) <= reach[m] ? size_of(away) : NONE;
      },
      may_join);
  return DONE;
}

// growth.move_to_creases; planes (M, 3) are per ray.
KERNEL move_to_creases(int64_t h, int64_t w, int64_t M, Doubles values, Doubles x, Doubles y,
                       int64_t* labels, Doubles planes, Doubles middles, Doubles reach,
                       int64_t num_turns, double straight, int64_t* rows, int64_t* marks,
                       int64_t* chosen) {
  if (!are_labels(labels, h * w, M)) return NO_SUCH_ROW;
  Front front(h, w, rows, marks, chosen);
  visit_borders(h, w, labels, [&](int64_t i, int64_t other) {
    if (labels[i] >= 0 && labels[other] >= 0) front.add(i), front.add(other);
  });
  front.spread(
      labels, num_turns,
      [&](int64_t pixel, int64_t q) {
        const int64_t label = labels[pixel], other = labels[q];
        if (other < 0 || other == label) return NONE;
        const double *one = planes + 3 * label, *two = planes + 3 * other;
        const double u = x[pixel % w], v = y[pixel / w];
        const double away = size_of(values[pixel] - (two[0] * u + two[1] * v + two[2]));
        if (!(away <= reach[other])) return NONE;
        const double a = one[0] - two[0], b = one[1] - two[1], c = one[2] - two[2];
        const auto over = [&](double u, double v) { return a * u + b * v + c; };
        const double next_u = x[q % w], next_v = y[q / w];
        const double here = over(u, v), there = over(next_u, next_v);
        const double mine = over(middles[2 * label], middles[2 * label + 1]),
                     theirs = over(middles[2 * other], middles[2 * other + 1]);
        const double slope = square_root(a * a + b * b);
        const double step = square_root(square(next_u - u) + square(next_v - v));
        const bool goes = size_of(there) - size_of(here) >= straight * slope * step &&
                          here * mine < 0 && mine * theirs < 0 && size_of(mine) > reach[other] &&
                          size_of(theirs) > reach[label];
        return goes ? away : NONE;
      },
      [&](int64_t pixel) { return labels[pixel] >= 0; });
  return DONE;
}

// growth.PixelGrid.contacts: number of contacts (M, M) between pixels of two regions, the smaller
// label first.
KERNEL count_contacts(int64_t h, int64_t w, int64_t M, Longs labels, int64_t* counts) {
  if (!are_labels(labels, h * w, M)) return NO_SUCH_ROW;
  for (int64_t pair = 0; pair < M * M; pair++) counts[pair] = 0;
  visit_borders(h, w, labels, [&](int64_t i, int64_t other) {
    const int64_t one = smaller(labels[i], labels[other]), two = larger(labels[i], labels[other]);
    if (one >= 0) counts[one * M + two]++;
  });
  return DONE;
}

// faces.count_lines: number of sampled rows and columns along which one region of a pair continues
// as the other behind a nearer object.
KERNEL count_lines(int64_t h, int64_t w, int64_t M, int64_t p, Doubles values, Doubles x, Doubles y,
                   Flagged seen, Longs labels, Doubles normals, Doubles centers, Doubles reach,
                   Longs pairs, int64_t every, double min_nearer, int64_t* counts, int64_t* firsts,
                   int64_t* lasts) {
  if (every < 1) return TOO_WIDE;
  if (!are_labels(labels, h * w, M)) return NO_SUCH_ROW;
  for (int64_t q = 0; q < 2 * p; q++)
    if (pairs[q] < 0 || pairs[q] >= M) return NO_SUCH_ROW;
  for (int64_t q = 0; q < p; q++) counts[q] = 0;
  for (int direction = 0; direction < 2; direction++) {
    const int64_t num_lines = direction ? w : h, length = direction ? h : w;
    const int64_t between = direction ? 1 : w, along = direction ? w : 1;
    for (int64_t m = 0; m < M; m++) firsts[m] = num_lines, lasts[m] = -1;
    for (int64_t line = 0; line < num_lines; line += every)
      for (int64_t i = 0; i < length; i++) {
        const int64_t m = labels[line * between + i * along];
        if (m >= 0 && lasts[m] < line) firsts[m] = smaller(firsts[m], line), lasts[m] = line;
      }
    for (int64_t q = 0; q < p; q++) {
      const int64_t first = pairs[2 * q], second = pairs[2 * q + 1];
      const double *normal = normals + 3 * first, *center = centers + 3 * first;
      for (int64_t line = larger(firsts[first], firsts[second]);
           line <= smaller(lasts[first], lasts[second]); line += every) {
        int64_t previous = -1, end = -1, passed = 0;
        bool leads = false;
        for (int64_t i = 0; i < length && !leads; i++) {
          const int64_t pixel = line * between + i * along, label = labels[pixel];
          const bool is_end = label == first || label == second;
          // Pixels before the first of either region are ignored.
          if (!is_end && (previous < 0 || !seen[pixel])) continue;
          const double point[3] = {x[direction ? line : i], y[direction ? i : line], values[pixel]};
          double height = 0;
          for (int axis = 0; axis < 3 && !is_end; axis++)
            height += (point[axis] - center[axis]) * normal[axis];
          if (is_end || height < -reach[first]) {
            const int64_t gap = i - previous - 1;
            leads = is_end && end >= 0 && end != label && gap > 0 &&
                    double(passed) >= min_nearer * double(gap);
            previous = i, end = is_end ? label : -1, passed = 0;
          }
          passed += height > reach[first];
        }
        counts[q] += leads;
      }
    }
  }
  return DONE;
}
