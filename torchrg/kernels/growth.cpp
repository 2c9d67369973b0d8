// Region growing and its edges: torchrg/regions/growth.py and edges.py.
#include "plain.h"

namespace {

constexpr int64_t AHEAD = 8;                    // seeds in the queue whose lists are loaded early
constexpr int64_t LINE = 64 / sizeof(int32_t);  // numbers in a line of the cache

// 1 with the sign of each lane.
INLINE Lanes sign_of(Lanes values) {
  constexpr int32_t ONE = 0x3F800000;  // the bits of 1
  const Flags signs = read_as<Flags>(&values) & (Flags{} + INT32_MIN);
  const Flags bits = signs | (Flags{} + ONE);
  return read_as<Lanes>(&bits);
}

// angles.sq_chords of normals.
INLINE Lanes sq_chords(const Vectors& normal, const Vectors& other, bool is_signed) {
  const Lanes sign = is_signed ? all(1) : sign_of(dot(other, normal));
  const Vectors turned = other - sign * normal;
  return dot(turned, turned);
}

// Vectors of the neighbors in a list.
struct Near {
  alignas(32) float values[3][MAX_WIDTH] = {};

  // Gathers them from vectors (3, N).
  INLINE_MEMBER void gather(Floats vectors, int64_t num_points, Ints list, int64_t k) {
    const float *x = vectors, *y = x + num_points, *z = y + num_points;
    for (int64_t j = 0; j < k; j++) {
      const int32_t t = list[j];
      values[0][j] = x[t], values[1][j] = y[t], values[2][j] = z[t];
    }
  }
  INLINE_MEMBER Vectors operator[](int64_t j) const {
    return {load(values[0] + j), load(values[1] + j), load(values[2] + j)};
  }
  INLINE_MEMBER Vectors first() const {
    return {all(values[0][0]), all(values[1][0]), all(values[2][0])};
  }
};

// Whether values are within a limit, or the limit is disabled.
INLINE Flags within(Lanes values, double limit) {
  return limit >= 0 ? values <= all(float(limit)) : ~Flags{};
}

}  // namespace

// edges.accept_edges: position and normal tests of edges to neighbors; points and normals (3, N);
// limits below 0 are disabled.
KERNEL pass_edges(int64_t num_points, int64_t num_rows, int64_t k, Floats points, Floats normals,
                  Flagged valid, Floats reach, Ints indices, Flagged mask, double max_sq_chord,
                  double max_sq_distance, int64_t is_signed, bool* joins) {
  if (k < 1 || k > MAX_WIDTH) return TOO_WIDE;
  Near near, near_normals;
  alignas(32) float reaches[MAX_WIDTH] = {};
  alignas(32) int32_t passes[MAX_WIDTH];
  const bool has_positions = reach || max_sq_distance >= 0;
  for (int64_t q = 0; q < num_rows; q++, indices += k, joins += k) {
    if (!are_rows(indices, k, num_points)) return NO_SUCH_ROW;
    const int32_t i = indices[0];
    for (int64_t j = 0; reach && j < k; j++) reaches[j] = reach[indices[j]];
    near_normals.gather(normals, num_points, indices, k);
    if (has_positions) near.gather(points, num_points, indices, k);
    const Vectors point = near.first(), normal = near_normals.first();
    for (int64_t j = 0; j < k; j += LANES) {
      const Vectors arm = near[j] - point, other = near_normals[j];
      Flags passed = within(sq_chords(normal, other, is_signed != 0), max_sq_chord);
      passed &= within(dot(arm, arm), max_sq_distance);
      if (reach) {
        passed &= magnitude(dot(arm, normal)) <= all(reach[i]);
        passed &= magnitude(dot(arm, other)) <= load(reaches + j);
      }
      store(passes + j, passed);
    }
    for (int64_t j = 0; j < k; j++) {
      const int32_t t = indices[j];
      joins[j] = valid[i] && valid[t] && t != i && passes[j] && (!mask || mask[q * k + j]);
    }
  }
  return DONE;
}

// paper.find_sharp_points: squared chords of the normals (3, N) of the first and all neighbors.
KERNEL neighbor_chords(int64_t num_points, int64_t num_rows, int64_t k, Floats normals,
                       Ints indices, float* chords) {
  if (k < 1 || k > MAX_WIDTH) return TOO_WIDE;
  Near near;
  alignas(32) float found[MAX_WIDTH];
  for (int64_t q = 0; q < num_rows; q++, indices += k, chords += k) {
    if (!are_rows(indices, k, num_points)) return NO_SUCH_ROW;
    near.gather(normals, num_points, indices, k);
    for (int64_t j = 0; j < k; j += LANES)
      store(found + j, sq_chords(near.first(), near[j], false));
    for (int64_t j = 0; j < k; j++) chords[j] = found[j];
  }
  return DONE;
}

// growth.grow_fifo, with one bit per neighbor in words of 64.
//
// A target becomes a seed if the bit of the edge is set or it is a seed already. With `late`
// promotion, other points join after all seeds of the region are known. `roots` start at -1, and
// `queue` is working memory.
KERNEL grow_regions(int64_t num_points, int64_t k, int64_t num_words, int64_t num_roots,
                    Ints indices, Longs joins, Longs makes_seed, Flagged is_seed, Flagged valid,
                    Ints order, int64_t late, int32_t* roots, int32_t* queue) {
  if (64 * num_words < k) return TOO_WIDE;
  for (int64_t r = 0; r < num_roots; r++) {
    const int32_t root = order[r];
    if (!is_row(root, num_points)) return NO_SUCH_ROW;
    if (roots[root] >= 0 || !valid[root]) continue;
    roots[root] = root, queue[0] = root;
    int64_t count = 1;
    for (int claims = 0; claims <= late; claims++)
      for (int64_t head = 0; head < count; head++) {
        const int64_t seed = queue[head];
        if (head + AHEAD < count)
          for (int64_t t = 0; t < k; t += LINE)
            __builtin_prefetch(indices + queue[head + AHEAD] * k + t);
        for (int64_t word = 0; word < num_words; word++) {
          const int32_t* list = indices + seed * k + 64 * word;
          const int64_t length = smaller(k - 64 * word, int64_t(64));
          if (!are_rows(list, length, num_points)) return NO_SUCH_ROW;
          uint64_t edges = joins[seed * num_words + word], unclaimed = 0;
          for (int64_t bit = 0; bit < length; bit++)
            unclaimed |= uint64_t(roots[list[bit]] < 0) << bit;
          const uint64_t promoting = makes_seed ? makes_seed[seed * num_words + word] : 0;
          if (late) edges &= claims ? ~promoting : promoting;
          for (edges &= unclaimed; edges; edges &= edges - 1) {
            const int bit = __builtin_ctzll(edges);
            const int32_t target = list[bit];
            if (roots[target] >= 0 || !valid[target]) continue;
            roots[target] = root;
            if (claims) continue;
            if (makes_seed ? promoting >> bit & 1 : is_seed && is_seed[target])
              queue[count++] = target;
          }
        }
      }
  }
  return DONE;
}

// adjacency._boundary_rows: which rows have a neighbor of another region in some columns.
KERNEL mark_boundary(int64_t num_points, int64_t k, int64_t num_rows, Ints labels, Ints indices,
                     Flagged mask, Ints rows, int64_t low, int64_t high, bool* meets) {
  if (low < 0 || high > k) return TOO_WIDE;
  for (int64_t r = 0; r < num_rows; r++) {
    const int64_t i = rows[r];
    if (!is_row(i, num_points) || !are_rows(indices + i * k + low, high - low, num_points))
      return NO_SUCH_ROW;
    int32_t differences = 0;
    for (int64_t e = i * k + low; e < i * k + high; e++) {
      const int32_t other = labels[indices[e]], counts = -int32_t(!mask || mask[e]);
      differences |= (other ^ labels[i]) & ~(other >> 31) & counts;  // negative labels do not count
    }
    meets[r] = differences != 0;
  }
  return DONE;
}

// adjacency._RegionEdges._find: edges of rows to other regions, in order, with the keys of their
// pairs.
KERNEL crossing_edges(int64_t num_points, int64_t k, int64_t num_rows, Ints labels, Ints indices,
                      Flagged mask, Ints rows, int64_t low, int64_t high, int64_t num_regions,
                      int32_t* sources, int32_t* targets, int32_t* columns, int64_t* keys,
                      int64_t* count) {
  if (low < 0 || high > k) return TOO_WIDE;
  int64_t found = 0;
  for (int64_t r = 0; r < num_rows; r++) {
    const int32_t i = rows[r];
    if (!is_row(i, num_points) || !are_rows(indices + i * k + low, high - low, num_points))
      return NO_SUCH_ROW;
    for (int64_t e = i * k + low; e < i * k + high; e++) {
      // Without a branch, which would be unpredictable: others overwrite it.
      const int32_t label = labels[i], other = labels[indices[e]];
      sources[found] = i, targets[found] = indices[e], columns[found] = int32_t(e - i * k - low);
      keys[found] = smaller(label, other) * num_regions + larger(label, other);
      found += (other != label) & (other >= 0) & (label >= 0) & (!mask || mask[e]);
    }
  }
  *count = found;
  return DONE;
}

// adjacency._length_on_line: distinct cells of the lines of pairs that contain the middle of an
// edge. `slots` is a hash table of indices of found cells.
KERNEL line_cells(int64_t num_points, int64_t num_edges, int64_t num_pairs, int64_t num_slots,
                  Floats points, Ints sources, Ints targets, Longs pairs, Doubles along,
                  Doubles spacing, double max_cell, int32_t* slots, int64_t* owners, int64_t* cells,
                  int64_t* count) {
  if (num_slots <= num_edges || num_slots & (num_slots - 1)) return TOO_WIDE;
  const uint64_t mask = uint64_t(num_slots) - 1;
  int32_t found = 0;
  for (int64_t slot = 0; slot < num_slots; slot++) slots[slot] = -1;
  for (int64_t e = 0; e < num_edges; e++) {
    const int64_t pair = pairs[e];
    if (!is_row(pair, num_pairs) || !is_row(sources[e], num_points) ||
        !is_row(targets[e], num_points))
      return NO_SUCH_ROW;
    if (!is_finite(spacing[pair])) continue;
    const float *start = points + 3 * int64_t(sources[e]), *end = points + 3 * int64_t(targets[e]);
    double position = 0;
    for (int axis = 0; axis < 3; axis++) {
      const double origin = points[axis];
      const double middle = ((start[axis] - origin) + (end[axis] - origin)) / 2;
      position += middle * along[3 * pair + axis];
    }
    position /= spacing[pair];
    if (!is_finite(position)) position = 0;
    const int64_t cell = int64_t(__builtin_floor(smaller(larger(position, -max_cell), max_cell)));
    uint64_t slot = (uint64_t(pair) * 0x9E3779B97F4A7C15u + uint64_t(cell)) * 0xD6E8FEB86659FD93u;
    for (slot = slot >> 24 & mask; slots[slot] >= 0; slot = (slot + 1) & mask)
      if (cells[slots[slot]] == cell && owners[slots[slot]] == pair) break;
    if (slots[slot] >= 0) continue;
    owners[found] = pair, cells[found] = cell, slots[slot] = found++;
  }
  *count = found;
  return DONE;
}

// shared_neighbors.connected_neighbors: whether both ends of edges from rows `first` on have
// `min_shared` common neighbors. Neighbor lists of a block of rows are bit sets over its members.
// `numbers` may be uninitialized: a number is valid only if the member with that number matches.
KERNEL connected(int64_t num_points, int64_t k, int64_t num_rows, Ints indices, Flagged mask,
                 Flagged selected, int32_t* numbers, int64_t first, int64_t min_shared,
                 bool* joined) {
  constexpr int WORDS = MAX_WIDTH / 64;
  if (k < 1 || k > MAX_WIDTH || first < 0 || num_rows > num_points - first) return TOO_WIDE;
  uint64_t bits[MAX_WIDTH][WORDS];
  int32_t members[MAX_WIDTH];
  int count = 0;
  const auto find = [&](int64_t point) {
    const int32_t number = numbers[point];
    return uint32_t(number) < uint32_t(count) && members[number] == point ? number : -1;
  };
  for (int64_t start = first, stop = first; start < first + num_rows; start = stop) {
    for (count = 0; stop < first + num_rows && count + k <= MAX_WIDTH; stop++) {
      if (!are_rows(indices + stop * k, k, num_points)) return NO_SUCH_ROW;
      for (int64_t e = stop * k; e < (stop + 1) * k; e++)
        if ((!mask || mask[e]) && find(indices[e]) < 0)
          numbers[indices[e]] = count, members[count++] = indices[e];
    }
    for (int m = 0; m < count; m++) {
      const int64_t list = members[m] * k;
      if (!are_rows(indices + list, k, num_points)) return NO_SUCH_ROW;
      for (uint64_t& word : bits[m]) word = 0;
      for (int64_t e = list; e < list + k; e++) {
        // Without branches, which would be unpredictable.
        const uint32_t number = smaller(uint32_t(numbers[indices[e]]), uint32_t(count - 1));
        const bool is_member = (members[number] == indices[e]) & (!mask || mask[e]);
        bits[m][number / 64] |= uint64_t(is_member) << number % 64;
      }
    }
    for (int64_t row = start; row < stop; row++) {
      const int one = find(row);
      for (int64_t e = row * k, edge = e - first * k; e < (row + 1) * k; e++, edge++) {
        const int other = selected[edge] ? find(indices[e]) : -1;
        int shared = 0;
        if (one >= 0 && other >= 0)
          for (int word = 0; word < WORDS; word++)
            shared += __builtin_popcountll(bits[one][word] & bits[other][word]);
        joined[edge] = selected[edge] && shared >= min_shared;
      }
    }
  }
  return DONE;
}
