"""What each kernel takes and returns, which :func:`torchrg.kernels.call` checks.

A letter for the dtype (f and d float32 and float64, i and l int32 and int64, b bool, x and n a
number with and without a fraction) and one for each axis, equal letters for equal lengths; a
question mark behind what may be None; capital letters for what the kernel writes to.
In C the lengths come first, in the order of their letters.
"""

SIGNATURES = {
    "majority_differences": "f[nk] -> f[n]",
    "are_coplanar": "f[3N] i[nk] b[nk]? f[n3] b[nk] b[nk]? x x -> b[nk]",
    "fit_normals_pca": "f[N3] i[nk] b[nk]? f[n] x x -> f[n3] f[n] f[n] b[n] b[n]",
    "survey": "f[N3] i[nk] b[nk]? f[n3] b[n] n n x x -> f[n] f[n] f[n] b[n] b[n] f[n] f[n]",
    "broken_planes": "f[N3] i[nk] b[nk]? f[n] f[n3] l[p2] f[c] -> f[n3] f[n] f[n3] f[n] f[n]",
    "smooth_planes": "f[N8] i[Nk] b[Nk]? f[N] l[n] x x x x x -> f[n3] f[n]",
    "choose_planes": "f[N8] i[Nk] b[Nk]? f[N3] l[n] n x x x x -> f[n3] f[n]",
    "inliers": "f[N3] i[Nk] b[Nk]? f[N3] f[N] f[N] l[n] x -> f[n] f[n3]",
    "fit_paraboloids": "f[N3] i[Nk] b[Nk]? f[N3] l[n] x -> f[n3] f[n] f[n]",
    "fill_cells": "d[N3] I[C] n n x x x x -> i[N] i[N] d[N3]",
    "search_cells": "d[N3] i[N] i[C] b[N] l[N]? I[Nk] B[N] n n n n n x x x x -> ",
    "pass_edges": "f[3N] f[3N] b[N] f[N]? i[nk] b[nk]? l[n] x x n -> b[nk]",
    "grow_regions": "i[Nk] l[Nw] l[Nw]? b[N]? b[N] i[n] n -> i[N] i[N]",
    "contact_differences": "f[N3] f[N3] l[N] l[n] i[nk] x x -> d[nk]",
    "gather_borders": "l[e] l[e] d[e] d[e] L[r] L[r] -> l[e] l[e] l[e] d[e] d[e] l[1]",
    "merging_costs": "d[R] d[RF] d[Rc] d[Rc] l[E] l[E] d[E] d[E] x x -> d[E]",
    "cheapest_borders": "l[E] l[E] d[E] D[R] -> l[R]",
    "neighbor_quantiles": "f[N] i[nk] b[nk]? x n -> f[n]",
    "fit_pixel_windows": "d[hw] b[hw] d[w] d[h] D[5hw] D[mpq] x x n n -> ",
    "fit_cell_windows": "d[mhw] D[5hw] D[mpq] x x n n -> ",
    "rate_windows": "D[9hw] d[pq] x x x x x x x x x n n n -> ",
    "offer_windows": "d[hw] b[hw] d[w] d[h] d[9pq] L[hw] B[hw] B[hw] n n n n -> ",
    "fit_narrow_windows": "d[hw] d[w] d[h] l[hw] l[n] x x D[52n] n n -> ",
    "choose_narrow": "d[hw] d[w] d[h] l[hw] l[n] d[92n] L[n] B[n] n n -> ",
    "describe_pixels": "d[hw] b[hw] d[w] d[h] l[hw] b[hw] d[N] d[M] l[n] D[hw3] D[hw] D[hw] D[hw] "
    "B[hw] x x x x x x n n -> ",
    "join_pixels": "l[hw] b[hw] d[hw3] d[hw] d[N] d[M] l[n] d[w] d[h] B[hw] B[hw] x x x n n -> ",
    "segment_rows": "l[n] n L[M] L[M] L[M] -> l[n]",
    "outer_places": "d[n] d[n] l[M] x -> b[n]",
    "segment_coordinates": "d[P] d[P] d[P] l[n] l[M] d[M3] d[MA3] -> d[An]",
    "segment_moments": "d[n] d[n] d[n] d[n] l[M] n -> d[M3] d[M33]",
    "reweigh_segments": "d[n] d[n] d[n] l[M] d[M3] d[M3] d[M] x x -> d[n] d[M] d[M]",
    "number_by_size": "l[n] n -> l[n] l[n] l[n]",
    "connect_pixels": "b[hw] b[hw] b[hw] -> l[hw]",
    "absorb_pixels": "d[3P] b[hw] L[hw] d[M3] d[M3] d[M] L[hw] L[hw] L[hw] -> ",
    "move_to_creases": "d[3P] L[hw] d[M3] d[M2] d[M] n x L[hw] L[hw] L[hw] -> ",
    "count_lines": "d[3nL] b[nL] l[nL] d[M3] d[M3] d[M] l[p2] x -> l[p] l[M] l[M]",
}
