"""Every constant of consensus normals: value, unit, meaning and reason, stage by stage.

``s`` is the noise about a point (standard deviation), ``R`` the radius of its neighbourhood.
``scripts/sensitivity.py`` halves and doubles each. All are read when the estimator is called.
"""

MIN_NEIGHBORS = 12
"""Neighbours. Fewer tell no surface from another (a paraboloid alone has 6 parameters): PCA."""
CHUNK_SIZE = 8192
"""Points. Handled in one step: columns of 50 neighbours fit the cache. Changes no result."""

NOISE_QUANTILE = 0.35
"""Share. Of the neighbours' deviations: low, as most neighbourhoods near an edge are on it."""
NOISE_COUNTS = (8, 16)
"""Neighbours. Small neighbourhoods, of which enough lie within one face at edges and corners."""
NOISE_FACTORS = (1.22, 1.1)
"""Per deviation. Noise by that quantile of the deviations of noisy planes: of m points, the root of
``(m - 3)`` by that quantile of chi-square with as many degrees of freedom."""
NOISE_FACTOR_OF_ALL = 1.04
"""Per deviation. The same for all neighbours."""
NOISE_LIMITS = (0.3425, 0.398)
"""Radii. What noise by these counts tends to as true noise grows, measured on noisy planes."""
COMMON_QUANTILE = 0.15
"""Share. Of the neighbours' noise: what a corner, where no neighbourhood is flat, goes by."""
MAX_ABOVE_COMMON = 3.0
"""Times. Noise above that common noise is shape."""
MIN_BREADTH = 0.03
"""Ratio of variances. Neighbours narrower than that lie on a line, as scan lines do."""
ADAPTIVE_NOISE = 0.15
"""Radii. Noise up to which k neighbours do; with ``adaptive_k`` they grow until it is that."""

FLAT_LIMIT = 1.05
"""s. Deviation up to which a plane stands."""
CURVED_LIMIT = 1.2
"""s. Deviation up to which a paraboloid stands: of 200 points that have an edge one is missed, of
those that have none half are spared the fits that follow."""
CURVED_SHARE = 0.15
"""Deviations of the plane. The same where noise is nearly nil; a symmetric edge has 0.27."""
FAR_OFF = 2.0
"""s. Deviation of the paraboloid from which votes are better, though two or three planes fail."""

NUM_CANDIDATES = 32
"""Planes. Candidates of the vote; each costs a pass over the neighbours."""
CANDIDATE_POWER = 1.5
"""Exponent. Ranks of the candidates' points: above 1 near points come more often."""
MIN_TRIANGLE = 0.1
"""Sine. Thinner triangles of point and two neighbours say nothing of the normal."""
VOTE_REACH = 2.0
"""s. Residual from which a neighbour votes against a plane."""
VOTE_FALLOFF = 0.9
"""Share. What the farthest neighbour's vote lacks of the nearest one's."""
FIT_REACH = 3.5
"""s. Reach of the bisquare weights of the last fit: nearly all the points of a face."""
FIT_FALLOFF = 0.5
"""Share. What the farthest neighbour's weight in that fit, and in smoothing, lacks."""
NUM_REFITS = 2
"""Fits. With each of the two reaches."""

NUM_ALTERNATIONS = 4
"""Times. Planes that meet, and who belongs to which, are fitted in turn."""
MEETING_GAP = 2.0
"""s. Points farther from one plane are the first guess of the other."""
MIN_PLANE_POINTS = 5
"""Points. A plane of fewer explains them whatever they are."""
CORNER_LIMIT = 1.15
"""s. Deviation of two planes above which three are tried."""
CORNER_SHARE = 0.9
"""Deviations of two planes. Three replace the two below that."""
MEETING_LIMIT = 1.3
"""s. Deviation up to which two or three planes explain the neighbours."""
MIN_GAIN = 8.0
"""Chi-square. Gain of the planes over the paraboloid that a point needs."""
MIN_POOLED_GAIN = 20.0
"""Chi-square. The same on average over its nearest: noise breaks single points, edges all."""
MAX_GAIN = 40.0
"""Chi-square. A single point gives that average no more."""
NUM_POOLED = 16
"""Neighbours. Those averaged."""

NUM_PASSES = 2
"""Times. Normals are smoothed and planes chosen among the neighbours'."""
MIN_ERROR = 0.003
"""Radians. Standard error of a normal (0.17 degrees) from which smoothing is worth its time."""
MAX_ERROR = 0.1
"""Radians. Largest standard error that a narrow face may claim."""
INLIER_REACH = 3.0
"""s. Neighbours within that distance of a sharp point's plane make its error and curvature."""
SMOOTHING_REACH = 2.5
"""s. Residual of the point from a neighbour's plane from which that has no say."""
SMOOTHING_AGREEMENT = 4.2
"""Standard errors. Chord between two normals from which they are different."""
MAX_TILT = 0.95
"""Share. Of a weight that the balance of positions may take away, or add."""
TILT_RIDGE = 0.01
"""Share of the trace. Keeps that balance solvable for points on a line."""
CHOICE_STEP = 3
"""Ranks. Every third neighbour's plane is tried: others add time only."""
CHOICE_REACH = 3.0
"""s. A point farther than that from a plane does not choose it."""
CHOICE_COST = 0.1
"""Score. Price of a residual of the point of one s, growing with its square."""
