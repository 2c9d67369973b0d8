"""Every constant of consensus normals: value, unit, meaning and reason, stage by stage.

Each begins with its unit; ``s`` is the noise about a point (standard deviation). All are read when
the estimator is called. Each ends with what ``scripts/sensitivity.py --quick`` finds when it alone
is halved or doubled: the largest change of a score, or "free" where F1 and mean best IoU change by
at most one face, the adjusted Rand index by 1 point, the mean angle by 0.05 degrees, the RMS by
0.25; where less than that factor was tried, how far it is free. Shares end at 1. Changes of 0.1 to
0.3 degrees on ``torus, adaptive k`` are near chance: that cloud has 1,500 points.
"""

MIN_NEIGHBORS = 12
"""Neighbours. Fewer tell no surface from another (a paraboloid alone has 6 parameters): PCA. Half:
free. Double: +2.9 deg mean, cube, k = 16 (free to x1.25)."""

NOISE_QUANTILE = 0.35
"""Share. Of the neighbours' deviations: low, as most neighbourhoods near an edge are on it. Half:
+3.6 deg mean, torus, adaptive k. Double: +3.6 deg mean, bracket."""
NOISE_COUNTS = (8, 16)
"""Neighbours. Small neighbourhoods, of which enough lie within one face at edges and corners. [0]
Half: +10 deg mean, torus, adaptive k. Double: +1.5 deg mean, cube, k = 16. [1] Half: +2.3 deg mean,
torus, adaptive k (free to x0.909). Double: +0.073 deg mean, bracket (free to x1.25)."""
NOISE_FACTORS = (1.22, 1.1)
"""Per deviation. Noise by that quantile of the deviations of noisy planes: of m points, the root of
``(m - 3)`` by that quantile of chi-square with as many degrees of freedom. [0] Half: +8.8 deg mean,
torus, adaptive k. Double: +1.3 deg mean, cube, k = 16. [1] Half: +7 deg mean, torus, adaptive k.
Double: +0.084 deg mean, bracket."""
NOISE_FACTOR_OF_ALL = 1.04
"""Per deviation. The same for all neighbours. Half: +4.4 deg mean, torus, adaptive k. Double:
+0.09 deg mean, room (free to x1.1)."""
NOISE_LIMITS = (0.3425, 0.398)
"""Radii. What noise by these counts tends to as true noise grows, measured on noisy planes. [0]
Half: -0.36 deg mean, torus, adaptive k. Double: +2.6 deg mean, torus, adaptive k. [1] Half: +0.093
deg mean, bracket (free to x0.8). Double: +0.21 deg mean, torus, adaptive k."""
COMMON_QUANTILE = 0.15
"""Share. Of the neighbours' noise: what a corner, where no neighbourhood is flat, goes by. Half:
-1.7 deg RMS, plate, exact. Double: +3.2 deg RMS, plate, exact."""
MAX_ABOVE_COMMON = 3.0
"""Times. Noise above that common noise is shape. Half: -0.34 deg mean, cube, k = 16 (free to
x0.8). Double: +0.09 deg mean, room (free to x1.5)."""
MAX_LAYERED_KURTOSIS = 2.2
"""Ratio. Of residuals from one plane, up to which two parallel ones are tried: 1 for both faces of
a plate without noise, 1.8 for even spread, 3 for noise. Half: +1.67 deg mean, plate, exact. Double:
-0.32 deg RMS, plate, exact (free to x1.1)."""
MAX_LAYERED_SHARE = 0.35
"""Deviations of one plane. What two parallel planes leave where they are the faces of a plate; they
leave 0.5 of even spread, 0.6 of noise. Half: -5.05 pt mIoU, room (free to x0.91). Double: +0.28 deg
mean, cube, k = 16 (free to x1.2)."""
MIN_BREADTH = 0.03
"""Ratio of variances. Neighbours narrower than that lie on a line, as scan lines do. Half, double:
free."""
ADAPTIVE_NOISE = 0.15
"""Radii. Noise up to which k neighbours do; with ``adaptive_k`` they grow until it is that. Half:
+14 deg mean, torus, adaptive k (free to x0.909). Double: free."""

FLAT_LIMIT = 1.05
"""s. Deviation up to which a plane stands. Half: +0.068 deg mean, cube, k = 16. Double: +0.64 deg
mean, torus."""
CURVED_LIMIT = 1.2
"""s. Deviation up to which a paraboloid stands: of 200 points that have an edge one is missed, of
those that have none half are spared the fits that follow. Half: +0.39 deg mean, torus, adaptive k.
Double: +4.9 deg mean, bracket."""
CURVED_SHARE = 0.15
"""Deviations of the plane. The same where noise is nearly nil; a symmetric edge has 0.27. Half:
free. Double: +6.5 deg RMS, cube, exact (free to x1.25)."""
FAR_OFF = 2.0
"""s. Deviation of the paraboloid from which votes are better, though two or three planes fail.
Half: +1.1 deg mean, torus, adaptive k. Double: +1.6 deg mean, cube, k = 16."""

NUM_CANDIDATES = 32
"""Planes. Candidates of the vote; each costs a pass over the neighbours. Half: +0.15 deg mean,
plate, exact (free to x0.8). Double: free."""
CANDIDATE_POWER = 1.5
"""Exponent. Ranks of the candidates' points: above 1 near points come more often. Half: +3 pt ARI,
office parts. Double: +0.078 deg mean, bracket."""
VOTE_REACH = 2.0
"""s. Residual from which a neighbour votes against a plane. Half: +0.18 deg mean, bracket. Double:
+0.26 deg mean, coral, exact (free to x1.1)."""
VOTE_FALLOFF = 0.9
"""Share. What the farthest neighbour's vote lacks of the nearest one's. Half: +0.12 deg mean,
coral, exact. Double: -0.38 deg RMS, plate, exact."""
FIT_REACH = 3.5
"""s. Reach of the bisquare weights of the last fit: nearly all the points of a face. Half: +0.13
deg mean, torus, adaptive k. Double: +0.45 deg mean, bracket."""
FIT_FALLOFF = 0.5
"""Share. What the farthest neighbour's weight in that fit, and in smoothing, lacks. Half: -0.079
deg mean, bracket. Double: +0.23 deg mean, bracket."""
NUM_REFITS = 2
"""Fits. With each of the two reaches. Half: +0.098 deg mean, bracket. Double: -0.073 deg mean,
torus, adaptive k."""

NUM_ALTERNATIONS = 4
"""Times. Planes that meet, and who belongs to which, are fitted in turn. Half: +0.35 deg mean,
bracket. Double: +0.68 deg RMS, plate, exact (free to x1.1)."""
MEETING_GAP = 2.0
"""s. Points farther from one plane are the first guess of the other. Half: +0.79 deg mean, bracket.
Double: -0.41 deg mean, torus, adaptive k."""
MIN_PLANE_POINTS = 5
"""Points. A plane of fewer explains them whatever they are. Half: -0.6 deg mean, cube, k = 16.
Double: +0.76 deg mean, bracket."""
CORNER_LIMIT = 1.15
"""s. Deviation of two planes above which three are tried. Half: -0.84 deg RMS, plate, exact.
Double: +0.32 deg mean, bracket (free to x1.1)."""
CORNER_SHARE = 0.9
"""Deviations of two planes. Three replace the two below that. Half: +0.22 deg mean, bracket.
Double: free."""
MEETING_LIMIT = 1.3
"""s. Deviation up to which two or three planes explain the neighbours. Half: +2.9 deg mean,
bracket. Double: +2.6 pt ARI, office parts."""
MIN_GAIN = 8.0
"""Chi-square. Gain of the planes over the paraboloid that a point needs. Half: free. Double: -0.051
deg mean, torus, adaptive k."""
MIN_POOLED_GAIN = 20.0
"""Chi-square. The same on average over its nearest: noise breaks single points, edges all. Half:
+0.33 deg mean, torus, adaptive k. Double: +2.9 deg mean, bracket."""
MAX_GAIN = 40.0
"""Chi-square. A single point gives that average no more. Half: +2.9 deg mean, bracket. Double:
-0.056 deg mean, rounded box."""
NUM_POOLED = 16
"""Neighbours. Those averaged. Half: +0.17 deg mean, torus, adaptive k. Double: -0.26 deg mean,
torus, adaptive k."""

NUM_PASSES = 2
"""Times. Normals are smoothed and planes chosen among the neighbours'. Half: +0.21 deg mean, cube,
k = 16. Double: +0.31 deg mean, torus, adaptive k."""
MIN_ERROR = 0.003
"""Radians. Standard error of a normal (0.17 degrees) from which smoothing is worth its time. Half:
free. Double: +0.095 deg mean, room."""
INLIER_REACH = 3.0
"""s. What is farther from a plane is not on it: neighbours have no part in the error and curvature
of a sharp point, and points do not choose that plane. Half: free. Double: +2.7 pt ARI, office
parts."""
SMOOTHING_REACH = 2.5
"""s. Residual of the point from a neighbour's plane from which that has no say. Half: +0.42 deg
mean, torus, adaptive k. Double: free."""
SMOOTHING_AGREEMENT = 4.2
"""Standard errors. Chord between two normals from which they are different. Half: +0.29 deg mean,
cube, k = 16. Double: -0.14 deg mean, cylinder."""
MAX_TILT = 0.95
"""Share. Of a weight that the balance of positions may take away, or add. Half: +0.35 deg mean,
torus, adaptive k. Double: free."""
TILT_RIDGE = 0.01
"""Share of the trace. Keeps that balance solvable for points on a line. Half, double: free."""
CHOICE_STEP = 3
"""Ranks. Every third neighbour's plane is tried: others add time only. Half: free. Double: +0.08
deg mean, plate, exact (free to x1.5)."""
CHOICE_COST = 0.1
"""Score. Price of a residual of the point of one s, growing with its square. Half: -1.2 pt ARI,
office parts. Double: free."""
