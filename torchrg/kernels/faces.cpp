// Connected components of a signed graph: torchrg/normals/faces.py.
#include "plain.h"

namespace {

// Disjoint-set forest. The root of a tree is its first node; signs are relative to the parent.
struct Forest {
  int32_t* parents;
  bool *is_flipped, *is_contradictory;

  // Replaces a node by its root with path halving; returns whether the signs of both differ.
  INLINE_MEMBER bool climb(int32_t& node) const {
    bool flipped = false;
    while (parents[node] != node) {
      const int32_t parent = parents[node];
      is_flipped[node] ^= is_flipped[parent];  // A root is not flipped.
      parents[node] = parents[parent];
      flipped ^= is_flipped[node], node = parents[node];
    }
    return flipped;
  }
};

}  // namespace

KERNEL link_nodes(int64_t num_links, int64_t num_nodes, Ints starts, Ints ends, Flagged flips,
                  int32_t* parents, bool* is_flipped, bool* is_contradictory) {
  if (!are_rows(starts, num_links, num_nodes) || !are_rows(ends, num_links, num_nodes) ||
      !are_rows(parents, num_nodes, num_nodes))
    return NO_SUCH_ROW;
  const Forest forest = {parents, is_flipped, is_contradictory};
  for (int64_t i = 0; i < num_links; i++) {
    int32_t low = starts[i], high = ends[i];
    const bool differs = forest.climb(low) ^ forest.climb(high) ^ flips[i];
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
