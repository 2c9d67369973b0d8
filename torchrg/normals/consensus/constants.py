"""Constants of consensus normals: value, unit, meaning and reason, by stage.

Each docstring begins with the unit (a fraction is at most 1). ``s`` is the local noise, a standard
deviation. All constants are read when the estimator is called. ``scripts/sensitivity.py`` measures
how halving or doubling each one changes the scores, in ``sensitivity.json`` next to it.
"""

MIN_NEIGHBORS = 12
"""Neighbors. Fewer cannot distinguish surfaces, since a paraboloid alone has 6 parameters; such
points keep the PCA normal."""
NOISE_QUANTILE = 0.35
"""Fraction. The noise is this quantile of the deviations at the neighbors. It is low because most
neighborhoods near an edge contain the edge, and deviate by their shape."""
NOISE_COUNTS = (8, 16)
"""Neighbors. Sizes of the small neighborhoods that measure deviations: at edges and corners enough
of them lie within one face."""
NOISE_FACTORS = (1.22, 1.1)
"""Per deviation. Convert that quantile of the deviations, for each neighborhood size, to noise. For
planes of m points they are the root of ``m - 3`` over the same quantile of chi-square with m - 3
degrees of freedom."""
NOISE_FACTOR_OF_ALL = 1.04
"""Per deviation. Converts that quantile to noise for the deviations of all neighbors together."""
NOISE_LIMITS = (0.3425, 0.398)
"""Radii. On planes, as the true noise grows, the noise from each neighborhood size tends to this
fraction of the radius. Larger noise cannot be measured."""
COMMON_QUANTILE = 0.15
"""Fraction. Quantile of the neighbors' noise that is their common noise, for corners, where no
neighborhood is flat."""
MAX_ABOVE_COMMON = 3.0
"""Factor. Noise that exceeds the common noise by this factor is treated as shape."""
REGIONAL_STEPS = 4
"""Steps. Neighbor-to-neighbor steps that define the region of the regional noise, if requested:
fewer merge small faces of fused meshes with the one behind them."""
REGIONAL_QUANTILE = 0.1
"""Fraction. Quantile over the neighbors in each of these steps. Higher quantiles do not leave the
slope of a step, because a neighborhood at its end lies mostly on it."""
REGIONAL_FRACTION = 0.8
"""Ratio. Fraction of the regional noise that is used. Both faces at a mesh step deviate from one
plane by little more than its bumps do, and a closer test loses nothing."""
MAX_LAYERED_KURTOSIS = 2.2
"""Ratio. Maximum kurtosis of the residuals from one plane for which two parallel planes are tried.
It is 1 for both faces of a noise-free plate, 1.8 for a uniform distribution, and 3 for noise."""
MAX_LAYERED_FRACTION = 0.35
"""Deviations of one plane. Two parallel planes are the faces of a plate if they leave at most this.
They leave 0.5 of a uniform distribution and 0.6 of noise."""
MIN_BREADTH = 0.03
"""Ratio of variances. Narrower neighborhoods lie on a line, such as a scan line, and do not define
a plane."""
ADAPTIVE_NOISE = 0.15
"""Radii. Up to this noise k neighbors are enough; with ``adaptive_k`` a noisier neighborhood grows
until its noise is this fraction of its radius."""
FLAT_LIMIT = 1.05
"""s. A plane is accepted if the neighbors deviate from it by at most this."""
CURVED_LIMIT = 1.2
"""s. A paraboloid is accepted if the neighbors deviate from it by at most this. A larger limit
misses edges; a smaller one sends more edge-free points to the later fits."""
CURVED_FRACTION = 0.15
"""Deviations of the plane. With almost no noise, a paraboloid is accepted if it leaves at most
this. A symmetric edge has 0.27."""
FAR_OFF = 2.0
"""s. If the neighbors deviate from the paraboloid by more than this, the voted plane is better even
if two or three planes fail."""
NUM_CANDIDATES = 32
"""Planes. Number of candidates of the vote; each costs one pass over the neighbors."""
CANDIDATE_POWER = 1.5
"""Exponent. The points of a candidate are drawn by rank to this power: above 1, near points are
drawn more often."""
VOTE_REACH = 2.0
"""s. A neighbor with a residual larger than this votes against a plane."""
VOTE_FALLOFF = 0.9
"""Fraction. Reduction of the vote of the farthest neighbor relative to the nearest one."""
FIT_REACH = 3.5
"""s. Reach of the bisquare weights of the last fit, which includes nearly all points of a face."""
FIT_FALLOFF = 0.5
"""Fraction. Reduction of the weight of the farthest neighbor, in the last fit and in smoothing."""
NUM_REFITS = 2
"""Fits. Number of fits with each of the two reaches, for the vote and the last fit, and of the two
faces of a plate."""
NUM_ALTERNATIONS = 4
"""Iterations. Alternating updates of meeting planes and of the points assigned to each."""
MEETING_GAP = 2.0
"""s. Points farther than this from one plane are the initial guess of the other one."""
MIN_PLANE_POINTS = 5
"""Points. A plane with fewer points fits them anywhere, and explains nothing."""
CORNER_LIMIT = 1.15
"""s. Three planes are tried if two planes leave a deviation above this."""
CORNER_FRACTION = 0.9
"""Deviations of two planes. Three planes replace two if they leave less than this."""
MEETING_LIMIT = 1.3
"""s. Two or three planes explain the neighbors if these deviate by at most this."""
MIN_GAIN = 8.0
"""Chi-square. Minimum gain over the paraboloid at which a point takes the meeting planes."""
MIN_POOLED_GAIN = 20.0
"""Chi-square. Minimum gain over the paraboloid averaged over the nearest neighbors. Noise gives
single points a gain; an edge gives it to all of them."""
MAX_GAIN = 40.0
"""Chi-square. Maximum contribution of a single point to that average."""
NUM_POOLED = 16
"""Neighbors. Number of nearest neighbors whose gains are averaged."""
NUM_PASSES = 2
"""Passes. Number of passes of smoothing and of plane choice."""
MIN_ERROR = 0.003
"""Radians. Minimum standard error of a normal, 0.17 degrees, that is worth smoothing."""
INLIER_REACH = 3.0
"""s. Maximum distance of an inlier. Farther neighbors are excluded from the error and the curvature
of a sharp point, and farther points do not choose that plane."""
SMOOTHING_REACH = 2.5
"""s. A neighbor is ignored in smoothing if the point is farther than this from its plane."""
SMOOTHING_AGREEMENT = 4.2
"""Standard errors. Two normals differ if the chord between them is longer than this."""
MAX_TILT = 0.95
"""Fraction. Maximum change of a weight by the position balance, up or down."""
TILT_RIDGE = 0.01
"""Fraction of the trace. Added to the diagonal so that the position balance can be solved for
collinear points."""
CHOICE_STEP = 3
"""Ranks. Every third neighbor offers its plane, to save time."""
CHOICE_COST = 0.1
"""Score. Cost of a residual of one s; it grows with the square of the residual."""
