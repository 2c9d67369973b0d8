// Links between normals, connected components of their graph, and free paths:
// torchrg/normals/faces.py and free_space.py.
#include "plain.h"

// faces._find_links: links of rows to neighbors at some ranks, which are in another group and bend
// by at most the limit; agreement of their normals, and bend.
KERNEL find_links(int64_t num_points, int64_t k, int64_t num_rows, int64_t num_ranks, Floats points,
                  Floats normals, Ints near, Longs rows, Longs ranks, Ints groups, double max_bend,
                  int32_t* starts, int32_t* ends, float* cosines, float* bends, int64_t* count) {
  if (!are_rows(ranks, num_ranks, k)) return TOO_WIDE;
  const float limit = float(max_bend);
  int64_t link = 0;
  for (int64_t i = 0; i < num_rows; i++) {
    const int64_t start = rows[i];
    if (!is_row(start, num_points)) return NO_SUCH_ROW;
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
  if (!are_rows(faces, num_rows, num_faces) || !are_rows(rows, num_rows, num_points))
    return NO_SUCH_ROW;
  for (int64_t face = 0; face < num_faces; face++) counts[face] = 0;
  for (int64_t i = 0; i < num_rows; i++) {
    const float *point = points + 3 * rows[i], *axis = axes + 3 * faces[i];
    heights[i] = point[0] * axis[0] + point[1] * axis[1] + point[2] * axis[2];
    counts[faces[i]]++;
  }
  const auto average = [&](double* averages, const auto& value) {
    for (int64_t face = 0; face < num_faces; face++) averages[face] = 0;
    for (int64_t i = 0; i < num_rows; i++) averages[faces[i]] += value(heights[i]);
    for (int64_t face = 0; face < num_faces; face++)
      averages[face] /= double(larger(counts[face], int64_t(1)));
  };
  const auto center = [&] {
    average(means, [](double height) { return height; });
    for (int64_t i = 0; i < num_rows; i++) heights[i] -= means[faces[i]];
  };
  const auto size = [](double height) { return size_of(height); };
  center();
  for (int pass = 0; pass < 2; pass++) {
    average(means, size);
    for (int64_t i = 0; i < num_rows; i++) {
      const double reach = max_height * means[faces[i]];
      heights[i] = larger(smaller(heights[i], reach), -reach);
    }
    center();
  }
  average(squares, [](double height) { return height * height; });
  average(means, size);
  for (int64_t face = 0; face < num_faces; face++) are_thin[face] = squares[face] <= max_square;
  for (int64_t i = 0; i < num_rows; i++) {
    const double mean = means[faces[i]], square = squares[faces[i]];
    sides[i] = (heights[i] > 0) & are_thin[faces[i]] & (mean * mean > min_two_sided * square);
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

// Joins the trees of linked nodes of a signed forest. The root of a tree is its first node, parents
// come before their children, and signs are relative to the parent; a root is not flipped.
KERNEL link_nodes(int64_t num_links, int64_t num_nodes, Ints starts, Ints ends, Flagged flips,
                  int32_t* parents, bool* is_flipped, bool* is_contradictory) {
  if (!are_rows(starts, num_links, num_nodes) || !are_rows(ends, num_links, num_nodes))
    return NO_SUCH_ROW;
  bool inside = true;
  // Replaces a node by its root with path halving; returns whether the signs of both differ.
  const auto climb = [&](int32_t& node) {
    bool flipped = false;
    for (int32_t parent = parents[node]; parent != node; parent = parents[node]) {
      const int32_t above = is_row(parent, node) ? parents[parent] : -1;
      inside &= is_row(above, int64_t(parent) + 1);
      if (!inside) break;
      is_flipped[node] ^= is_flipped[parent];
      flipped ^= is_flipped[node];
      node = parents[node] = above;
    }
    return flipped;
  };
  for (int64_t i = 0; i < num_links; i++) {
    int32_t one = starts[i], other = ends[i];
    const bool differs = climb(one) ^ climb(other) ^ flips[i];
    if (!inside) return NO_SUCH_ROW;
    const int32_t low = smaller(one, other), high = larger(one, other);
    if (low == high) {
      is_contradictory[low] |= differs;
    } else {
      parents[high] = low, is_flipped[high] = differs;
      is_contradictory[low] |= is_contradictory[high];
    }
  }
  return DONE;
}

// Points each node directly at its root.
KERNEL flatten_nodes(int64_t num_nodes, int32_t* parents, bool* is_flipped,
                     bool* is_contradictory) {
  for (int64_t node = 0; node < num_nodes; node++) {
    const int32_t parent = parents[node];
    if (!is_row(parent, node + 1)) return NO_SUCH_ROW;
    if (parent == node) continue;
    is_flipped[node] ^= is_flipped[parent], is_contradictory[node] = is_contradictory[parent];
    parents[node] = parents[parent];
  }
  return DONE;
}
