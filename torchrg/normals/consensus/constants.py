"""Every constant of consensus normals: value, unit, meaning and reason, stage by stage.

Each docstring begins with the unit. There ``s`` is the noise about a point, a standard deviation.
All constants are read when the estimator is called. What becomes of the scores when one of them is
halved or doubled is measured by ``scripts/sensitivity.py`` and kept in ``sensitivity.json`` beside
it.
"""

MIN_NEIGHBORS = 12
"""Neighbours. Fewer do not tell one surface from another, as a paraboloid alone has 6 parameters;
such points keep the normal of PCA."""

NOISE_QUANTILE = 0.35
"""Share. The noise is this quantile of the deviations that the neighbours find around themselves.
It is low because most neighbourhoods near an edge contain the edge, and deviate by their shape."""
NOISE_COUNTS = (8, 16)
"""Neighbours. Sizes of the small neighbourhoods whose deviations are taken: at edges and corners
enough of them lie within one face."""
NOISE_FACTORS = (1.22, 1.1)
"""Per deviation. Turn that quantile of the deviations, for each size of neighbourhood, into noise.
For planes of m points they are the root of ``m - 3`` by the same quantile of chi-square with m - 3
degrees of freedom."""
NOISE_FACTOR_OF_ALL = 1.04
"""Per deviation. Turns that quantile into noise where the deviations are those of all neighbours
together."""
NOISE_LIMITS = (0.3425, 0.398)
"""Radii. On planes, as the true noise grows, noise from each size of neighbourhood tends to this
share of the radius, so nothing beyond it can be measured."""
COMMON_QUANTILE = 0.15
"""Share. Quantile of the noise of the neighbours that counts as their common noise. A corner goes
by it, as no neighbourhood is flat there."""
MAX_ABOVE_COMMON = 3.0
"""Times. Noise that is larger than the common noise by this factor is taken for shape."""
REGIONAL_STEPS = 4
"""Steps. So many from neighbour to neighbour away is noise that counts as that of the region, where
it is asked for: fewer leave small faces of fused meshes in the one behind them."""
REGIONAL_QUANTILE = 0.1
"""Share. Quantile over the neighbours in each of these steps: higher ones do not leave the slope of
a step, as a neighbourhood at its end lies on it for the most part."""
REGIONAL_FRACTION = 0.8
"""Ratio. What counts of the noise of the region: both faces at a step of a mesh deviate from one
plane by little more than its bumps do, and what is looked at closely loses nothing."""
MAX_LAYERED_KURTOSIS = 2.2
"""Ratio. Kurtosis of the residuals from one plane up to which two parallel planes are tried. It is
1 for both faces of a plate without noise, 1.8 for an even spread, and 3 for noise."""
MAX_LAYERED_FRACTION = 0.35
"""Deviations of one plane. Two parallel planes are the faces of a plate if they leave no more than
this. They leave 0.5 of an even spread and 0.6 of noise."""
MIN_BREADTH = 0.03
"""Ratio of variances. Neighbours that are narrower than this lie on a line, as a scan line does,
and say nothing about a plane."""
ADAPTIVE_NOISE = 0.15
"""Radii. Up to this noise k neighbours are enough; with ``adaptive_k`` a noisier neighbourhood
grows until its noise is this share of its radius."""

FLAT_LIMIT = 1.05
"""s. A plane stands if the neighbours deviate from it by no more than this."""
CURVED_LIMIT = 1.2
"""s. A paraboloid stands if the neighbours deviate from it by no more than this. A larger one
misses edges; a smaller one spares fewer points without an edge the fits that come later."""
CURVED_FRACTION = 0.15
"""Deviations of the plane. Where there is next to no noise, a paraboloid stands if it leaves no
more than this. A symmetric edge has 0.27."""
FAR_OFF = 2.0
"""s. If the neighbours deviate from the paraboloid by more than this, the vote is better even where
two or three planes fail."""

NUM_CANDIDATES = 32
"""Planes. Candidates of the vote; each costs one pass over the neighbours."""
CANDIDATE_POWER = 1.5
"""Exponent. The points of a candidate are drawn by rank to this power: above 1, near points come
more often."""
VOTE_REACH = 2.0
"""s. A neighbour whose residual is larger than this votes against a plane."""
VOTE_FALLOFF = 0.9
"""Share. The vote of the farthest neighbour lacks this part of the vote of the nearest one."""
FIT_REACH = 3.5
"""s. Reach of the bisquare weights of the last fit, which takes in nearly all points of a face."""
FIT_FALLOFF = 0.5
"""Share. In the last fit and in smoothing the weight of the farthest neighbour lacks this part of
the weight of the nearest one."""
NUM_REFITS = 2
"""Fits. Number of fits with each of the two reaches, that of the vote and that of the last fit, and
of the two faces of a plate."""

NUM_ALTERNATIONS = 4
"""Times. Planes that meet and the points that belong to each are found in turn this often."""
MEETING_GAP = 2.0
"""s. The points that are farther than this from one plane are the first guess of the other one."""
MIN_PLANE_POINTS = 5
"""Points. A plane with fewer points fits them wherever they are, and explains nothing."""
CORNER_LIMIT = 1.15
"""s. Three planes are tried where two planes leave a deviation above this."""
CORNER_FRACTION = 0.9
"""Deviations of two planes. Three planes replace two if they leave less than this."""
MEETING_LIMIT = 1.3
"""s. Two or three planes explain the neighbours if these deviate by no more than this."""
MIN_GAIN = 8.0
"""Chi-square. A point takes the planes that meet only if they gain this much on the paraboloid."""
MIN_POOLED_GAIN = 20.0
"""Chi-square. The gain on the paraboloid, averaged over the nearest neighbours, must be this much
too. Noise gives single points a gain; an edge gives it to all of them."""
MAX_GAIN = 40.0
"""Chi-square. In that average a single point counts with no more than this."""
NUM_POOLED = 16
"""Neighbours. Number of the nearest neighbours whose gains are averaged."""

NUM_PASSES = 2
"""Times. Normals are smoothed, and planes are chosen among those of the neighbours, this often."""
MIN_ERROR = 0.003
"""Radians. Standard error of a normal, 0.17 degrees, from which smoothing is worth its time."""
INLIER_REACH = 3.0
"""s. A point that is farther than this from a plane is not on it. Such a neighbour has no part in
the error and the curvature of a sharp point, and such a point does not choose that plane."""
SMOOTHING_REACH = 2.5
"""s. A neighbour has no say in smoothing if the point is farther than this from its plane."""
SMOOTHING_AGREEMENT = 4.2
"""Standard errors. Two normals are different if the chord between them is longer than this."""
MAX_TILT = 0.95
"""Share. The balance of positions may take away, or add, at most this part of a weight."""
TILT_RIDGE = 0.01
"""Share of the trace. Added to the diagonal so that the balance of positions can be solved for
points on a line."""
CHOICE_STEP = 3
"""Ranks. Every third neighbour offers its plane; the others would only take time."""
CHOICE_COST = 0.1
"""Score. Price of a residual of one s; it grows with the square of the residual."""
