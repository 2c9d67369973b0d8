// Links between normals, connected components of their graph, and free paths:
// torchrg/normals/faces.py and free_space.py.
#include "plain.h"

namespace {

// Disjoint-set forest. The root of a tree is its first node; signs are relative to the parent.
struct Forest {
  int32_t* parents;
  bool *is_flipped, *is_contradictory;

  // Replaces a node by its root with path halving; returns whether the signs of both differ.
  INLINE_MEMBER bool climb(int32_t& node) const {
    bool flipped = false;
    // Parents come before their children; a node of a broken forest becomes -1.
    for (int32_t parent = parents[node]; parent != node; parent = parents[node]) {
      const int32_t above = parent >= 0 && parent < node ? parents[parent] : -1;
      if (above < 0 || above > parent) {
        node = -1;
        return false;
      }
      is_flipped[node] ^= is_flipped[parent];  // A root is not flipped.
      parents[node] = above;
      flipped ^= is_flipped[node], node = above;
    }
    return flipped;
  }
};

}  // namespace

// faces._find_links: links of rows to neighbors at some ranks, which are in another group and bend
// by at most the limit; agreement of their normals, and bend.
KERNEL find_links(int64_t num_points, int64_t k, int64_t num_rows, int64_t num_ranks, Floats points,
                  Floats normals, Ints near, Longs rows, Longs ranks, Ints groups, double max_bend,
                  int32_t* starts, int32_t* ends, float* cosines, float* bends, int64_t* count) {
  for (int64_t r = 0; r < num_ranks; r++)
    if (ranks[r] < 0 || ranks[r] >= k) return TOO_WIDE;
  const float limit = float(max_bend);
  int64_t link = 0;
  for (int64_t i = 0; i < num_rows; i++) {
    const int64_t start = rows[i];
    if (start < 0 || start >= num_points) return NO_SUCH_ROW;
    const float *point = points + 3 * start, *normal = normals + 3 * start;
    for (int64_t r = 0; r < num_ranks; r++) {
      const int32_t neighbor = near[start * k + ranks[r]];
      if (!is_row(neighbor, num_points)) return NO_SUCH_ROW;
      if (groups && (groups[neighbor] < 0 || groups[neighbor] == groups[start])) continue;
      const float *end = points + 3 * int64_t(neighbor), *other = normals + 3 * int64_t(neighbor);
      float cosine = 0, here = 0, there = 0, square = 0;
      for (int axis = 0; axis < 3; axis++) {
        const float arm = end[axis] - point[axis];
        cosine += other[axis] * normal[axis], here += arm * normal[axis];
        there += arm * other[axis], square += arm * arm;
      }
      if (!(square > 0)) square = 1;
      cosine -= 2 * here * there / square;
      const float bend = 1 - size_of(cosine) + (here * here + there * there) / square;
      if (!(bend <= limit)) continue;
      starts[link] = int32_t(start), ends[link] = neighbor;
      cosines[link] = cosine, bends[link++] = bend;
    }
  }
  *count = link;
  return DONE;
}

// faces._split_plates: side of each point of a plate, and thin faces.
KERNEL split_plates(int64_t num_points, int64_t num_rows, int64_t num_faces, Floats points,
                    Longs rows, Longs faces, Floats axes, double max_square, double max_height,
                    double min_two_sided, bool* sides, bool* are_thin, double* heights,
                    double* means, double* squares, int64_t* counts) {
  for (int64_t i = 0; i < num_rows; i++) {
    const int64_t face = faces[i], row = rows[i];
    if (face < 0 || face >= num_faces || row < 0 || row >= num_points) return NO_SUCH_ROW;
    const float *point = points + 3 * row, *axis = axes + 3 * face;
    heights[i] = point[0] * axis[0] + point[1] * axis[1] + point[2] * axis[2];
  }
  for (int64_t face = 0; face < num_faces; face++) counts[face] = 0;
  for (int64_t i = 0; i < num_rows; i++) counts[faces[i]]++;
  const auto average = [&](const auto& value) {
    for (int64_t face = 0; face < num_faces; face++) means[face] = 0;
    for (int64_t i = 0; i < num_rows; i++) means[faces[i]] += value(heights[i]);
    for (int64_t face = 0; face < num_faces; face++)
      means[face] /= double(larger(counts[face], int64_t(1)));
  };
  const auto itself = [](double height) { return height; };
  const auto size = [](double height) { return size_of(height); };
  const auto square = [](double height) { return height * height; };
  average(itself);
  for (int64_t i = 0; i < num_rows; i++) heights[i] -= means[faces[i]];
  for (int pass = 0; pass < 2; pass++) {
    average(size);
    for (int64_t i = 0; i < num_rows; i++) {
      const double reach = max_height * means[faces[i]];
      heights[i] = larger(smaller(heights[i], reach), -reach);
    }
    average(itself);
    for (int64_t i = 0; i < num_rows; i++) heights[i] -= means[faces[i]];
  }
  average(square);
  for (int64_t i = 0; i < num_rows; i++) sides[i] = heights[i] > 0;
  for (int64_t face = 0; face < num_faces; face++)
    are_thin[face] = means[face] <= max_square, squares[face] = means[face];
  average(size);
  for (int64_t i = 0; i < num_rows; i++) {
    const int64_t face = faces[i];
    const bool is_plate =
        are_thin[face] && means[face] * means[face] > min_two_sided * squares[face];
    sides[i] &= is_plate;
  }
  return DONE;
}

// free_space._free_gaps: free cells from each cell to the next one ahead and behind in a direction,
// -1 if there is none. Cells (3, C) are ascending and so is the direction: the last cell of a line
// is the previous one. Blocks of eight neighboring lines share a cache line of the hash table.
KERNEL free_gaps(int64_t num_cells, int64_t num_slots, Ints cells, int64_t x, int64_t y, int64_t z,
                 int64_t* lines, int32_t* last, int32_t* ahead, int32_t* behind) {
  if (num_slots < 2 * num_cells + 8 || num_slots & (num_slots - 1)) return TOO_WIDE;
  const int64_t steps[3] = {x, y, z};
  const int a = x ? 0 : y ? 1 : 2, b = a == 0, c = a == 2 ? 1 : 2;
  const Ints along = cells + a * num_cells, first = cells + b * num_cells,
             second = cells + c * num_cells;
  const uint64_t mask = uint64_t(num_slots) - 1;
  for (int64_t slot = 0; slot < num_slots; slot++) last[slot] = -1;
  for (int64_t cell = 0; cell < num_cells; cell++) {
    const int64_t position = along[cell], row = first[cell] - steps[b] * position,
                  column = second[cell] - steps[c] * position;
    const int64_t line = int64_t((uint64_t(row) << 32) + uint64_t(column));
    const uint64_t block = uint64_t(row) * 0x9E3779B97F4A7C15u ^ uint64_t(column >> 3);
    uint64_t slot = (block * 0xD6E8FEB86659FD93u >> 24 << 3 | uint64_t(column & 7)) & mask;
    while (last[slot] >= 0 && lines[slot] != line) slot = (slot + 9) & mask;
    const int32_t previous = last[slot];
    ahead[cell] = behind[cell] = -1;
    if (previous >= 0) ahead[previous] = behind[cell] = int32_t(position - along[previous] - 1);
    lines[slot] = line, last[slot] = int32_t(cell);
  }
  return DONE;
}

KERNEL link_nodes(int64_t num_links, int64_t num_nodes, Ints starts, Ints ends, Flagged flips,
                  int32_t* parents, bool* is_flipped, bool* is_contradictory) {
  if (!are_rows(starts, num_links, num_nodes) || !are_rows(ends, num_links, num_nodes))
    return NO_SUCH_ROW;
  const Forest forest = {parents, is_flipped, is_contradictory};
  for (int64_t i = 0; i < num_links; i++) {
    int32_t low = starts[i], high = ends[i];
    const bool differs = forest.climb(low) ^ forest.climb(high) ^ flips[i];
    if (low < 0 || high < 0) return NO_SUCH_ROW;
    if (low == high) {
      is_contradictory[low] |= differs;
      continue;
    }
    if (low > high) {
      const int32_t other = low;
      low = high, high = other;
    }
    parents[high] = low, is_flipped[high] = differs;
    is_contradictory[low] |= is_contradictory[high];
  }
  return DONE;
}

// Points each node directly at its root.
KERNEL flatten_nodes(int64_t num_nodes, int32_t* parents, bool* is_flipped,
                     bool* is_contradictory) {
  for (int64_t node = 0; node < num_nodes; node++) {
    const int32_t parent = parents[node];
    if (parent < 0 || parent > node) return NO_SUCH_ROW;
    if (parent == node) continue;
    is_flipped[node] ^= is_flipped[parent], is_contradictory[node] = is_contradictory[parent];
    parents[node] = parents[parent];
  }
  return DONE;
}
