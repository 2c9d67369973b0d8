"""Depth frames of a box-shaped room, cast ray by ray, in the folders of phones and data sets."""

import json
from typing import NamedTuple

import numpy as np

from torchrg.render import write_png

SIZE = np.array([4.0, 3.0, 2.5])
"""Sides of the room in meters; a corner is the origin, z points up."""
WIDTH, HEIGHT = 128, 96
FX, FY, CX, CY = 832.0, 840.0, 505.0, 390.0
"""Camera of the color images, in pixels from their corner, where the first middle is 0.5."""
ENLARGED = 8
"""Pixels of a color image along one of a depth image."""
COLOR = (ENLARGED * WIDTH, ENLARGED * HEIGHT)
UNSURE = np.zeros((HEIGHT, WIDTH), dtype=bool)
UNSURE[20:40, 30:90] = True
"""Pixels whose depth is wrong, and of confidence 0, in captures that have it."""


class MadeFrame(NamedTuple):
    """A depth image in meters ``(H, W)``, its points ``(H, W, 3)``, and the turn and place."""

    depth: np.ndarray
    points: np.ndarray
    turn: np.ndarray
    place: np.ndarray

    def pose(self, *signs):
        """Return the matrix to the world from axes that are x right, y up, z backwards, turned."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.turn * signs, self.place
        return pose


def cast_frame(azimuth, place):
    """Return what a camera in the room sees that looks level and a little down."""
    sin, cos = np.sin(azimuth), np.cos(azimuth)
    back = np.array([-cos, -sin, 0.25])
    back /= np.linalg.norm(back)
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    turn, place = np.stack([right, np.cross(back, right), back], axis=1), np.array(place)
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    across = ((columns + 0.5) * ENLARGED - CX) / FX
    up = -((rows + 0.5) * ENLARGED - CY) / FY
    rays = np.stack([across, up, -np.ones_like(up)], axis=-1) @ turn.T
    with np.errstate(divide="ignore"):
        reach = np.where(rays > 0, SIZE - place, -place) / rays
    depth = np.abs(reach).min(axis=-1)
    return MadeFrame(depth, place + depth[..., None] * rays, turn, place)


FRAMES = [cast_frame(0.6, (1.0, 1.0, 1.4)), cast_frame(2.5, (2.5, 1.2, 1.5))]
GL, CV = (1, 1, 1), (1, -1, -1)
"""Signs of the axes of a camera of OpenGL, and of one whose y points down and z forwards."""


def write_depth(path, depth, scale=1000.0):
    """Write depth in meters as its suffix says: whole numbers as PNG or PGM, or floating point."""
    path.parent.mkdir(parents=True, exist_ok=True)
    values = (depth * scale).round().astype(np.int32)
    if path.suffix == ".png":
        write_png(path, values)
    elif path.suffix == ".pgm":
        head = f"P5\n# made\n{WIDTH} {HEIGHT}\n65535\n".encode()
        path.write_bytes(head + values.astype(">u2").tobytes())
    elif path.suffix == ".exr":
        import OpenEXR

        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"R": (depth * scale).astype(np.float32)}).write(str(path))
    else:
        np.save(path, (depth * scale).astype(np.float32))


def write_confidence(path, high):
    """Write a gray image of 8 bits: 0 where depth is not sure, ``high`` otherwise."""
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.where(UNSURE, 0, high).astype(np.uint8)).save(path)


def make_unsure(depth):
    """Return depth that is wrong where it is not sure."""
    return np.where(UNSURE, 0.7 * depth, depth)


def write_text(path, text):
    """Write a text file and its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text if isinstance(text, str) else json.dumps(text))


def camera_of_depth(first_middle):
    """Return fx, fy, cx, cy of the depth images, where the middle of the first pixel is so."""
    off = first_middle - 0.5
    return [FX / ENLARGED, FY / ENLARGED, CX / ENLARGED + off, CY / ENLARGED + off]


def write_nerfstudio(root, suffix=".png", scale=1000.0, **more):
    """Write ``transforms.json``, whose intrinsics are of color images, and its depth images."""
    names = {"fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "w": COLOR[0], "h": COLOR[1]}
    frames = []
    for number, frame in enumerate(FRAMES):
        depth = f"./depth/frame_{number:05d}{suffix}"
        write_depth(root / depth, frame.depth, scale)
        frames.append(
            {
                "file_path": f"images/frame_{number:05d}.jpg",
                "depth_file_path": depth,
                "transform_matrix": frame.pose(*GL).tolist(),
            }
        )
    write_text(root / "transforms.json", {**names, **more, "frames": frames})
    return root


def write_arkitscenes(root):
    """Write a video of ARKitScenes, with poses from world to camera as axis and angle."""
    from scipy.spatial.transform import Rotation

    scan, rows = root / "Training" / "40753679", []
    fx, fy, cx, cy = camera_of_depth(0)
    for time, off, frame in zip((6791.2, 6791.3), (0.0, 0.001), FRAMES, strict=True):
        write_depth(scan / "lowres_depth" / f"40753679_{time:.3f}.png", make_unsure(frame.depth))
        write_confidence(scan / "confidence" / f"40753679_{time:.3f}.png", 2)
        name = f"40753679_{time + off:.3f}.pincam"
        text = f"{WIDTH} {HEIGHT} {fx} {fy} {cx} {cy}"
        write_text(scan / "lowres_wide_intrinsics" / name, text)
        back = np.linalg.inv(frame.pose(*CV))
        angles = Rotation.from_matrix(back[:3, :3]).as_rotvec()
        rows.append(" ".join(map(repr, map(float, [time + off, *angles, *back[:3, 3]]))))
    write_text(scan / "lowres_wide.traj", "\n".join(rows))
    return root


def write_replica(root):
    """Write a room of Replica as NICE-SLAM gives it."""
    fx, fy, cx, cy = camera_of_depth(0)
    camera = {"w": WIDTH, "h": HEIGHT, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "scale": 6553.5}
    write_text(root / "cam_params.json", {"camera": camera})
    for number, frame in enumerate(FRAMES):
        write_depth(root / "room0" / "results" / f"depth{number:06d}.png", frame.depth, 6553.5)
    rows = (" ".join(map(str, frame.pose(*CV).ravel().tolist())) for frame in FRAMES)
    write_text(root / "room0" / "traj.txt", "\n".join(rows))
    return root


def write_scannetpp(root):
    """Write frames of an iPhone of ScanNet++, whose intrinsics are of 1920 x 1440 pixels."""
    scan, records = root / "data" / "0a5c013435", {}
    larger = 1920 / COLOR[0]
    matrix = [[FX * larger, 0, CX * larger - 0.5], [0, FY * larger, CY * larger - 0.5], [0, 0, 1]]
    for number, frame in enumerate(FRAMES):
        name = f"frame_{10 * number:06d}"
        write_depth(scan / "iphone" / "depth" / f"{name}.png", frame.depth)
        pose = frame.pose(*CV).tolist()
        records[name] = {"pose": np.eye(4).tolist(), "aligned_pose": pose, "intrinsic": matrix}
    write_text(scan / "iphone" / "pose_intrinsic_imu.json", records)
    write_text(scan / "dslr" / "nerfstudio" / "transforms.json", {"frames": []})
    return root


def write_3rscan(root):
    """Write a sequence of 3RScan, with one rendered image."""
    folder = root / "0988ea72" / "sequence"
    fx, fy, cx, cy = camera_of_depth(0)
    info = f"""m_sensorName = Tango
m_colorWidth = 960
m_depthWidth = {WIDTH}
m_depthHeight = {HEIGHT}
m_depthShift = 1000
m_calibrationColorIntrinsic = 756 0 492 0 0 756 270 0 0 0 1 0 0 0 0 1
m_calibrationDepthIntrinsic = {fx} 0 {cx} 0 0 {fy} {cy} 0 0 0 1 0 0 0 0 1
"""
    write_text(folder / "_info.txt", info)
    for number, frame in enumerate(FRAMES):
        write_depth(folder / f"frame-{number:06d}.depth.pgm", frame.depth)
        rows = (" ".join(map(str, row)) for row in frame.pose(*CV).tolist())
        write_text(folder / f"frame-{number:06d}.pose.txt", "\n".join(rows))
    write_depth(folder / "frame-000000.rendered.depth.png", FRAMES[0].depth)
    return root


def quaternion_of(pose):
    """Return the rotation of a pose as x y z w."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()


def phone_intrinsics():
    """Return fx, fy, cx, cy of an iPhone's color images of 1920 x 1440 pixels."""
    larger = 1920 / COLOR[0]
    return [FX * larger, FY * larger, CX * larger - 0.5, CY * larger - 0.5]


def write_stray(root, per_frame=False):
    """Write a recording of Stray Scanner.

    Format: strayrobots/scanner, docs/format.md and StrayScanner/Helpers: columns are ``timestamp,
    frame, x, y, z, qx, qy, qz, qw``, in later versions with ``fx, fy, cx, cy`` and empty cells;
    ``camera_matrix.csv`` has the rows of the matrix of the last frame; ``q_WA * q_AC`` turns
    ARKit's axes into x right, y down, z forwards; depth is in millimeters; confidence is 0 to 2.
    """
    fx, fy, cx, cy = phone_intrinsics()
    header = "timestamp, frame, x, y, z, qx, qy, qz, qw"
    rows = [header + ", fx, fy, cx, cy, distortion_center_x" if per_frame else header]
    for number, frame in reversed([*enumerate(FRAMES)]):
        name = f"{5 * number:06d}"
        write_depth(root / "depth" / f"{name}.png", make_unsure(frame.depth))
        write_confidence(root / "confidence" / f"{name}.png", 2)
        numbers = [*frame.place, *quaternion_of(frame.pose(*CV))]
        row = ", ".join([str(100 + number / 60), name, *map(str, numbers)])
        rows.append(f"{row}, {fx}, {fy}, {cx}, {cy}, " if per_frame else row)
    if per_frame:
        fx, cx = 0.9 * fx, 0.9 * cx
    write_text(root / "odometry.csv", "\n".join(rows) + "\n")
    write_text(root / "camera_matrix.csv", f"{fx}, 0.0, {cx}\n0.0, {fy}, {cy}\n0.0, 0.0, 1.0")
    (root / "rgb.mp4").write_bytes(b"")
    return root


def write_polycam(root):
    """Write the raw data of Polycam, with optimized poses.

    Format: PolyCam/polyform, README.md and polyform/core/capture_folder.py, and nerfstudio,
    process_data/polycam_utils.py: ``t_ij`` is row i, column j, from the camera (x right, y up, z
    backwards) to ARKit's world; intrinsics are of the color image; depth is in millimeters;
    confidence is 0, 127 or 255.
    """
    inside = root / "keyframes"
    fx, fy, cx, cy = FX, FY, CX - 0.5, CY - 0.5
    camera = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": COLOR[0], "height": COLOR[1]}
    for number, frame in enumerate(FRAMES):
        name = f"{62910452125 + 33333 * number}"
        write_depth(inside / "depth" / f"{name}.png", make_unsure(frame.depth))
        write_confidence(inside / "confidence" / f"{name}.png", 127)
        for folder, turn in (
            ("corrected_cameras", np.eye(4)),
            ("cameras", np.eye(4)[[1, 2, 0, 3]]),
        ):
            pose = (turn @ frame.pose(*GL)).tolist()
            cells = {f"t_{i}{j}": pose[i][j] for i in range(3) for j in range(4)}
            write_text(inside / folder / f"{name}.json", {**camera, **cells, "blur_score": 61.2})
    write_text(root / "mesh_info.json", {"alignmentTransform": np.eye(4).ravel().tolist()})
    return root


def write_record3d(root, suffix=".npy", per_frame=False):
    """Write an export of Record3D.

    Format: marek-simonik/record3d, issues 36, 64 and 67, and nerfstudio,
    process_data/record3d_utils.py: ``K`` is column-major, of color images of ``w`` x ``h`` pixels;
    ``poses`` are ``qx qy qz qw tx ty tz`` from the camera (OpenGL's axes) to the world; depth is in
    meters, as OpenEXR of one channel; ``perFrameIntrinsicCoeffs`` are rows of ``fx fy cx cy``.
    """
    fx, fy, cx, cy = FX, FY, CX - 0.5, CY - 0.5
    scan = root / "EXR_RGBD"
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    metadata = {"w": COLOR[0], "h": COLOR[1], "fps": 60, "initPose": [0, 0, 0, 1, 0, 0, 0]}
    metadata["poses"] = [[*quaternion_of(frame.turn), *frame.place] for frame in FRAMES]
    if per_frame:
        metadata["perFrameIntrinsicCoeffs"] = [[fx, fy, cx, cy]] * len(FRAMES)
        matrix[0] *= 0.9
    metadata["K"] = matrix.T.ravel().tolist()
    write_text(scan / "metadata.json", metadata)
    scale = 1000.0 if suffix == ".png" else 1.0
    for number, frame in enumerate(FRAMES):
        write_depth(scan / "depth" / f"{number}{suffix}", frame.depth, scale)
    return root


def write_rtabmap(root, is_by_id=True):
    """Write what ``rtabmap-export --images_id --poses_camera --poses_format 11`` does.

    Format: introlab/rtabmap, tools/Export/main.cpp and corelib/src/CameraModel.cpp, issues 749 and
    1253: images and cameras are named by ID, or with ``--images`` by time (``%f``); poses are
    ``stamp x y z qx qy qz qw id`` of the optical axes; ``camera_matrix`` was wrong for years, so
    the projection counts; depth is in millimeters.
    """
    fx, fy, cx, cy = FX, FY, CX - 0.5, CY - 0.5
    rows = ["#timestamp x y z qx qy qz qw id"]
    for number, frame in enumerate(FRAMES):
        stamp, node = 1.0 + number, 3 - number
        name = f"{node}" if is_by_id else f"{stamp:f}"
        write_depth(root / "map_depth" / f"{name}.png", frame.depth)
        numbers = " ".join(map(str, [*frame.place, *quaternion_of(frame.pose(*CV))]))
        rows.append(f"{stamp:f} {numbers} {node}")
        text = f"""%YAML:1.0
---
camera_name: "{name}"
image_width: {COLOR[0]}
image_height: {COLOR[1]}
camera_matrix:
   rows: 3
   cols: 3
   data: [ {fx}, 0., {cx}, 0., 0., {fy}, {cy}, 0., 0. ]
projection_matrix:
   rows: 3
   cols: 4
   data: [ {fx}, 0., {cx}, 0., 0.,
       {fy}, {cy}, 0., 0., 0., 1., 0. ]
local_transform:
   rows: 3
   cols: 4
   data: [ 0., 0., 1., 0., -1., 0., 0., 0., 0., -1., 0., 0. ]
"""
        write_text(root / "map_calib" / f"{name}.yaml", text)
    write_text(root / "map_camera_poses.txt", "\n".join(rows))
    return root


WRITERS = {
    "nerfstudio": write_nerfstudio,
    "arkitscenes": write_arkitscenes,
    "replica": write_replica,
    "scannetpp": write_scannetpp,
    "3rscan": write_3rscan,
    "stray": write_stray,
    "polycam": write_polycam,
    "record3d": write_record3d,
    "rtabmap": write_rtabmap,
}
"""What writes each kind of capture below a folder and returns it."""
