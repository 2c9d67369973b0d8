"""What the paper printed, to be put beside what comes out here."""

NORMAL_SECONDS = {
    "pca": {0.25: 5.253, 1.2: 6.858, 2.4: 7.567},
    "jet": {0.25: 9.235, 1.2: 10.259, 2.4: 8.236},
    "irls": {0.25: 6.858, 1.2: 8.075, 2.4: 7.567},
    "detmm": {0.25: 602.491, 1.2: 621.695, 2.4: 710.536},
    "paper": {0.25: 38.58, 1.2: 37.613, 2.4: 43.817},
}
"""Table 1, seconds by noise in percent: C++ for the first two, MPI for the third, MATLAB for the
rest, AMD R7-4800U; it does not say how many points."""

INDICES = {
    "tutorial": {
        "classic_increment": (0.2115, 0.5951, 2.0324, 10.002, 100.0, 49.3, 66.0),
        "detmm": (0.1061, 0.4139, 1.417, 4.7684, 78.4, 100.0, 87.9),
        "paper": (0.0903, 0.6337, 1.7324, 4.9920, 82.6, 100.0, 90.5),
    },
    "hallway": {
        "classic_increment": (0.1118, 0.4324, 1.9665, 6.7303, 51.9, 89.6, 62.9),
        "detmm": (0.1274, 0.4289, 1.4581, 4.7684, 90.7, 68.3, 77.9),
        "paper": (0.1009, 0.6253, 1.0637, 4.9174, 90.8, 100.0, 95.2),
    },
}
"""Table 2: CP, SP, DBI, DVI, precision, recall, F1 of each cloud and method."""

INDEX_NAMES = ("cp", "sp", "dbi", "dvi", "precision", "recall", "f1")

MINUTES = {
    "tutorial": {"classic_increment": 0.06, "detmm": 30.96, "paper": 1.92},
    "hallway": {"classic_increment": 0.33, "detmm": 165.92, "paper": 3.06},
    "cory": {"classic_increment": 0.42, "detmm": 314.44, "paper": 9.84},
    "kinect": {"classic_increment": 0.56, "detmm": 277.39, "paper": 7.75},
}
"""Table 3, AMD R7-4800U, MATLAB without acceleration."""

POINTS = {"tutorial": 108_104, "hallway": 579_313, "cory": 1_097_901, "kinect": 968_520}
"""Table 3: sizes of the clouds."""
