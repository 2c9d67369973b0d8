// Nearest neighbors on a cell grid: torchrg/neighbors/knn.py.
#include "plain.h"

namespace {

constexpr int MAX_CANDIDATES = 4096;  // points of a cell and those around it
constexpr int MAX_CHOSEN = 1024;      // of these, the sorted ones
constexpr double SURELY = 1e-6;       // rounding of the cell of a point at a boundary

#ifdef __AVX2__
constexpr int SHORT_LANES = 16;
#else
constexpr int SHORT_LANES = 8;
#endif
typedef int16_t Shorts __attribute__((vector_size(2 * SHORT_LANES)));

struct Candidates {
  alignas(32) double x[MAX_CANDIDATES], y[MAX_CANDIDATES], z[MAX_CANDIDATES],
      square[MAX_CANDIDATES];
  alignas(32) float key[MAX_CANDIDATES + LANES];  // squared distances, rounded
  int32_t row[MAX_CANDIDATES], sorted[MAX_CHOSEN];
  alignas(32) float chosen_key[MAX_CHOSEN + LANES];
  alignas(32) int32_t chosen[MAX_CHOSEN + LANES];
  alignas(32) int16_t step[MAX_CHOSEN], rank[MAX_CHOSEN];  // keys in steps, and their ranks
};

#ifdef __AVX2__
// Lanes in an order that moves flagged ones to the front.
struct Orders {
  alignas(32) int32_t lanes[1 << LANES][LANES];

  constexpr Orders() : lanes() {
    for (int bits = 0; bits < 1 << LANES; bits++)
      for (int lane = 0, n = 0; lane < LANES; lane++)
        if (bits >> lane & 1) lanes[bits][n++] = lane;
  }
};
constexpr Orders ORDERS;
#endif

// Chooses candidates with keys below a limit, at most MAX_CHOSEN and some; returns their number.
INLINE int choose(Candidates& all, int n, float limit) {
  int count = 0;
  for (int t = 0; t < n && count <= MAX_CHOSEN; t += LANES) {
    const Lanes keys = load(all.key + t);
    const Flags flags = keys < limit;
#ifdef __AVX2__
    const int bits = __builtin_ia32_movmskps256((Lanes)flags);
    const Flags order = load(ORDERS.lanes[bits]), numbers = order + t;
    store(all.chosen_key + count, (Lanes)__builtin_ia32_permvarsf256(keys, order));
    __builtin_memcpy(all.chosen + count, &numbers, sizeof numbers);
    count += __builtin_popcount(bits);
#else
    for (int lane = 0; lane < LANES; lane++) {
      all.chosen_key[count] = keys[lane], all.chosen[count] = t + lane;
      count -= flags[lane];
    }
#endif
  }
  return count;
}

// Sorts chosen candidates by distance, then row.
INLINE void sort(Candidates& all, int count, float limit) {
  constexpr int BLOCK = 2 * SHORT_LANES;
  const float scale = smaller(65535 / limit, 3e38f);  // finite for tiny limits
  const int width = (count + BLOCK - 1) / BLOCK * BLOCK;
  for (int i = count; i < width; i++) all.chosen_key[i] = 0;
  for (int i = 0; i < width; i++) all.step[i] = int16_t(int(all.chosen_key[i] * scale) - 32768);
  // The rank of a step is the number of steps below it.
  for (int i = 0; i < width; i += BLOCK) {
    Shorts steps[2], ranks[2] = {};
    __builtin_memcpy(steps, all.step + i, sizeof steps);
    for (int j = 0; j < count; j++) {
      const Shorts other = Shorts{} + all.step[j];
      ranks[0] -= other < steps[0], ranks[1] -= other < steps[1];
    }
    __builtin_memcpy(all.rank + i, ranks, sizeof ranks);
  }
  int sum = 0;
  for (int i = 0; i < count; i++) sum += all.rank[i], all.sorted[all.rank[i]] = all.chosen[i];
  if (sum == count * (count - 1) / 2) return;
  // Equal steps share a rank: place them one after another, and sort each run.
  const auto is_before = [&](int a, int b) {
    if (all.key[a] != all.key[b]) return all.key[a] < all.key[b];
    const double here = square_root(all.square[a]), there = square_root(all.square[b]);
    return here < there || (here == there && all.row[a] < all.row[b]);
  };
  for (int i = 0; i < count; i++) all.sorted[i] = -1;
  for (int i = 0; i < count; i++) {
    int at = all.rank[i];
    while (all.sorted[at] >= 0) at++;
    for (; at > all.rank[i] && is_before(all.chosen[i], all.sorted[at - 1]); at--)
      all.sorted[at] = all.sorted[at - 1];
    all.sorted[at] = all.chosen[i];
  }
}

// Inserts two zero bits between the bits of a number below 2^21.
INLINE uint64_t spread(uint64_t bits) {
  bits = (bits | bits << 32) & 0x1F00000000FFFF;
  bits = (bits | bits << 16) & 0x1F0000FF0000FF;
  bits = (bits | bits << 8) & 0x100F00F00F00F00F;
  bits = (bits | bits << 4) & 0x10C30C30C30C30C3;
  return (bits | bits << 2) & 0x1249249249249249;
}

}  // namespace

// Morton codes of finite points in a cube: torchrg/neighbors/order.py.
KERNEL morton_codes(int64_t num_points, const double* points, double x, double y, double z,
                    double extent, int64_t* codes) {
  const double low[3] = {x, y, z};
  for (int64_t i = 0; i < num_points; i++) {
    uint64_t code = 0;
    for (int axis = 0; axis < 3; axis++)
      code |= spread(int64_t((points[3 * i + axis] - low[axis]) / extent * 2097151)) << axis;
    codes[i] = int64_t(code);
  }
  return DONE;
}

// order.sort_integers: rows that sort keys, ties by row, and the keys in this order; a radix sort
// by bytes, lowest first, without bytes that are the same in all keys.
KERNEL sort_integers(int64_t n, Longs keys, int64_t* rows, int64_t* sorted, int64_t* other_rows,
                     int64_t* others) {
  constexpr int BYTES = 8, VALUES = 256;
  int64_t counts[BYTES][VALUES] = {};
  const auto digit = [](int64_t key, int byte) {
    return (uint64_t(key) ^ uint64_t(1) << 63) >> 8 * byte & 255;
  };
  for (int64_t i = 0; i < n; i++) {
    rows[i] = i, sorted[i] = keys[i];
    for (int byte = 0; byte < BYTES; byte++) counts[byte][digit(keys[i], byte)]++;
  }
  int64_t *from = sorted, *from_rows = rows, *to = others, *to_rows = other_rows;
  for (int byte = 0; byte < BYTES && n > 0; byte++) {
    int64_t(&next)[VALUES] = counts[byte], before = 0;
    if (next[digit(keys[0], byte)] == n) continue;
    for (int64_t& count : next) {
      const int64_t start = before;
      before += count, count = start;
    }
    for (int64_t i = 0; i < n; i++) {
      const int64_t position = next[digit(from[i], byte)]++;
      to[position] = from[i], to_rows[position] = from_rows[i];
    }
    int64_t *const used = from, *const used_rows = from_rows;
    from = to, from_rows = to_rows, to = used, to_rows = used_rows;
  }
  for (int64_t i = 0; from != sorted && i < n; i++) sorted[i] = from[i], rows[i] = from_rows[i];
  return DONE;
}

// Sorts points by cell: `starts` receives the first index of each cell, then the end.
KERNEL fill_cells(int64_t num_points, int64_t num_cells, const double* points, int32_t* starts,
                  int64_t width, int64_t height, double x, double y, double z, double size,
                  int32_t* rows, int32_t* cells) {
  if (num_points > INT32_MAX || num_cells > INT32_MAX) return TOO_WIDE;  // rows and cells: int32
  if (width < 1 || height < 1 || width > num_cells || height > num_cells) return TOO_WIDE;
  const double length = double(num_cells / (width * height));
  for (int64_t c = 0; c < num_cells; c++) starts[c] = 0;
  for (int64_t i = 0; i < num_points; i++) {
    const double* p = points + 3 * i;
    const double u = (p[0] - x) / size, v = (p[1] - y) / size, w = (p[2] - z) / size;
    bool inside = u >= 0 && u < length && v >= 0 && v < width - 2 && w >= 0 && w < height - 2;
    if (!inside) return NO_SUCH_ROW;
    const int64_t cell = (int64_t(u + 1) * width + int64_t(v + 1)) * height + int64_t(w + 1);
    if (cell + 1 >= num_cells) return NO_SUCH_ROW;
    cells[i] = int32_t(cell), starts[cell]++;
  }
  int32_t before = 0;
  for (int64_t c = 0; c < num_cells; c++) before += starts[c], starts[c] = before;
  for (int64_t i = num_points - 1; i >= 0; i--) rows[--starts[cells[i]]] = int32_t(i);
  return DONE;
}

// Writes the k nearest neighbors of points in cells `from` to `to` to their rows of `found`, their
// targets, and sets resolved targets to -1, for no request. `order` renumbers neighbors if given.
KERNEL search_cells(int64_t num_points, int64_t num_cells, int64_t num_lists, int64_t k,
                    const double* points, Ints rows, Ints starts, int32_t* targets, Longs order,
                    int32_t* found, int64_t from, int64_t to, int64_t width,
                    int64_t height, int64_t first_row, double x, double y, double z, double size) {
  if (k < 1 || k > MAX_WIDTH || from < 0 || to > num_cells - 1) return TOO_WIDE;
  if (width < 1 || height < 1 || width > num_cells || height > num_cells) return TOO_WIDE;
  if (num_points > INT32_MAX || num_cells > INT32_MAX) return TOO_WIDE;
  Candidates all;
  const int64_t step = width * height;
  float guess = 0;
  for (int64_t c = from; c < to; c++) {
    bool is_empty = true;
    for (int64_t position = starts[c]; position < starts[c + 1]; position++) {
      if (position < 0 || position >= num_points || !is_row(rows[position], num_points))
        return NO_SUCH_ROW;
      is_empty &= targets[rows[position]] < 0;
    }
    if (is_empty) continue;
    int64_t number = 0, first[9], length[9];
    for (int g = 0; g < 9; g++) {
      const int64_t middle = c + (g / 3 - 1) * step + (g % 3 - 1) * height;
      if (middle < 1 || middle + 2 >= num_cells) return NO_SUCH_ROW;
      first[g] = starts[middle - 1], length[g] = starts[middle + 2] - first[g];
      if (first[g] < 0 || length[g] < 0 || first[g] + length[g] > num_points) return NO_SUCH_ROW;
      number += length[g];
    }
    if (number <= k || number > MAX_CANDIDATES) continue;
    int n = 0;
    for (int g = 0; g < 9; g++) {
      if (!are_rows(rows + first[g], length[g], num_points)) return NO_SUCH_ROW;
      for (int64_t t = first[g]; t < first[g] + length[g]; t++, n++) {
        const double* p = points + 3 * int64_t(rows[t]);
        all.x[n] = p[0], all.y[n] = p[1], all.z[n] = p[2], all.row[n] = rows[t];
      }
    }
    for (int t = n; t < padded(n); t++) all.key[t] = INFINITE;
    const double u = x + (double(c / step) - 0.5) * size, w = z + (double(c % height) - 0.5) * size,
                 v = y + (double(c / height % width) - 0.5) * size;
    for (int64_t position = starts[c]; position < starts[c + 1]; position++) {
      const int32_t row = rows[position];
      if (targets[row] < 0) continue;
      const double *query = points + 3 * int64_t(row), px = query[0], py = query[1], pz = query[2];
      for (int t = 0; t < n; t++) {
        const double a = all.x[t] - px, b = all.y[t] - py, d = all.z[t] - pz;
        all.square[t] = a * a + b * b + d * d, all.key[t] = float(all.square[t]);
      }
      const double off = larger(larger(size_of(px - u), size_of(py - v)), size_of(pz - w));
      const double border = (1.5 * size - off) * (1 - SURELY);
      const float max_square = float(border * border);
      float within = guess > 0 && guess < max_square ? guess : max_square;
      int count = 0;
      for (int turn = 0; turn < 8; turn++) {
        count = choose(all, n, within);
        if (count > MAX_CHOSEN)
          within *= 0.7f;
        else if (count < k && within < max_square)
          within = smaller(within * 1.6f, max_square);
        else
          break;
      }
      if (count < k || count > MAX_CHOSEN) continue;
      if (targets[row] >= num_lists) return NO_SUCH_ROW;
      int32_t* list = found + k * targets[row];
      sort(all, count, within);
      const double farthest = square_root(all.square[all.sorted[k - 1]]);
      // Whether a point outside could tie with the last neighbor by rounding.
      if (!(farthest * (1 + SURELY) < square_root(double(within)))) continue;
      for (int j = 0; j < k; j++) {
        const int32_t near = all.row[all.sorted[j]];
        list[j] = int32_t((order ? order[near] : int64_t(near)) + first_row);
      }
      targets[row] = -1;
      guess = float(farthest * farthest * 1.2);
    }
  }
  return DONE;
}
