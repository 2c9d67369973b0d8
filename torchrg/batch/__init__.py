"""Whole data sets: many scans, on one machine or on a cluster, and a record of each."""
