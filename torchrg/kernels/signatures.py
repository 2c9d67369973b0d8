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
}
