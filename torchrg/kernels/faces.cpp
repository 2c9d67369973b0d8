// Links between normals, and connected components of their graph: torchrg/normals/faces.py.
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

// faces._compare: agreement of normals along links, and the bend of links.
KERNEL compare_links(int64_t num_points, int64_t num_rows, int64_t k, Floats points, Floats normals,
                     Longs rows, Ints ends, float* cosines, float* bends) {
  if (!are_rows(ends, num_rows * k, num_points)) return NO_SUCH_ROW;
  for (int64_t i = 0; i < num_rows; i++) {
    if (rows[i] < 0 || rows[i] >= num_points) return NO_SUCH_ROW;
    const float *point = points + 3 * rows[i], *normal = normals + 3 * rows[i];
    for (int64_t link = i * k; link < (i + 1) * k; link++) {
      const int64_t neighbor = 3 * int64_t(ends[link]);
      const float *end = points + neighbor, *other = normals + neighbor;
      float cosine = 0, here = 0, there = 0, square = 0;
      for (int axis = 0; axis < 3; axis++) {
        const float arm = end[axis] - point[axis];
        cosine += other[axis] * normal[axis], here += arm * normal[axis];
        there += arm * other[axis], square += arm * arm;
      }
      if (!(square > 0)) square = 1;
      cosine -= 2 * here * there / square;
      cosines[link] = cosine;
      bends[link] = 1 - size_of(cosine) + (here * here + there * there) / square;
    }
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
