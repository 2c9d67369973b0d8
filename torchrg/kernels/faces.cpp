// Connected components of a signed graph: torchrg/normals/faces.py.
#include "plain.h"

namespace {

// A forest of nodes. The root of a tree is its first node; signs are relative to the parent.
struct Forest {
  int32_t* parents;
  bool *is_turned, *is_torn;

  // Moves a node to its root, halves its path, and returns whether its sign differs from the root.
  INLINE_MEMBER bool climb(int32_t& node) const {
    bool turned = false;
    while (parents[node] != node) {
      const int32_t parent = parents[node];
      is_turned[node] ^= is_turned[parent];  // A root is not turned.
      parents[node] = parents[parent];
      turned ^= is_turned[node], node = parents[node];
    }
    return turned;
  }
};

}  // namespace

KERNEL link_nodes(int64_t num_links, int64_t num_nodes, Ints starts, Ints ends, Flagged turns,
                  int32_t* parents, bool* is_turned, bool* is_torn) {
  if (!are_rows(starts, num_links, num_nodes) || !are_rows(ends, num_links, num_nodes) ||
      !are_rows(parents, num_nodes, num_nodes))
    return NO_SUCH_ROW;
  const Forest forest = {parents, is_turned, is_torn};
  for (int64_t i = 0; i < num_links; i++) {
    int32_t low = starts[i], high = ends[i];
    const bool differs = forest.climb(low) ^ forest.climb(high) ^ turns[i];
    if (low == high) {
      is_torn[low] |= differs;
      continue;
    }
    if (low > high) {
      const int32_t other = low;
      low = high, high = other;
    }
    parents[high] = low, is_turned[high] = differs, is_torn[low] |= is_torn[high];
  }
  return DONE;
}

// Makes the root of each node its parent.
KERNEL flatten_nodes(int64_t num_nodes, int32_t* parents, bool* is_turned, bool* is_torn) {
  for (int64_t node = 0; node < num_nodes; node++) {
    const int32_t parent = parents[node];
    if (parent < 0 || parent > node) return NO_SUCH_ROW;
    if (parent == node) continue;
    is_turned[node] ^= is_turned[parent], is_torn[node] = is_torn[parent];
    parents[node] = parents[parent];
  }
  return DONE;
}
