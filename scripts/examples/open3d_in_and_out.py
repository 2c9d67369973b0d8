"""Segment a cloud of Open3D, and return normals, plane colors and labels to Open3D.

python scripts/examples/open3d_in_and_out.py scan.ply planes.ply
"""

import sys

import open3d as o3d

import torchrg

source, target = sys.argv[1:]
cloud = o3d.t.io.read_point_cloud(source)
points = cloud.point.positions.numpy()
seg = torchrg.segment_planes(points)
cloud.point.normals = seg.normals.numpy()
cloud.point.colors = torchrg.render.color_planes(seg.labels, points).numpy()
cloud.point.label = seg.labels[:, None].int().numpy()
o3d.t.io.write_point_cloud(target, cloud)

# The older class of Open3D, as for o3d.visualization.draw_geometries:
legacy = cloud.to_legacy()
largest = legacy.select_by_index((seg.labels == 0).nonzero()[:, 0].tolist())
print(f"{len(seg.planes)} planes; the largest has {len(largest.points)} points")
