"""Small drives in the layouts of others, all with the poses of ``drive_formats``."""

import json
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
from drive_formats import T_BODY_CAMERA, euroc, numbers, stamps, truth, written, wxyz
from pyarrow import feather
from scipy.spatial.transform import Rotation
from street_places import geodetic

from semviz_core.base.pose import Pose
from semviz_core.datasets.own_drive.recording import DriveFiles

K = [50.0, 0.0, 31.5, 0.0, 50.0, 23.5, 0.0, 0.0, 1.0]
T_RIGHT_LEFT = Pose(np.eye(3), np.array([-0.5, 0.0, 0.0]))
T_BODY_RIGHT = T_BODY_CAMERA @ T_RIGHT_LEFT.inverse()


def bodies() -> list[Pose]:
    return [truth(index) @ T_BODY_CAMERA.inverse() for index in range(len(stamps()))]


def images(folder: Path, names: list[str]) -> Path:
    folder.mkdir(parents=True)
    for name in names:
        assert cv2.imwrite(str(folder / name), np.zeros((48, 64, 3), np.uint8))
    return folder


def kitti_raw(root: Path) -> DriveFiles:
    """Rectified by 0.02 rad; the third image of camera 2 is missing."""
    date, drive = root / "2011_09_26", root / "2011_09_26" / "2011_09_26_drive_0001_sync"
    numbered = [f"{index:010d}.png" for index in range(len(stamps()))]
    images(drive / "image_02" / "data", [*numbered[:2], *numbered[3:]])
    images(drive / "image_03" / "data", numbered)
    R_rect = Pose.from_rotvec([0.0, 0.02, 0.01], [0.0, 0.0, 0.0])
    T_velo_imu = Pose.from_rotvec([0.0, 0.0, 0.01], [-0.8, 0.3, -0.8])
    T_cam2_rect0 = Pose(np.eye(3), np.array([0.06, 0.0, 0.0]))
    T_cam0_velo = R_rect.inverse() @ T_cam2_rect0.inverse() @ T_BODY_CAMERA.inverse()
    T_cam0_velo = T_cam0_velo @ T_velo_imu.inverse()
    rows = ["calib_time: 09-Jan-2012 13:57:47", "R_rect_00: " + numbers(*R_rect.rotation.ravel())]
    for camera, shift in (("02", 0.06), ("03", -0.44)):
        P = np.column_stack([np.reshape(K, (3, 3)), [50.0 * shift, 0.0, 0.0]])
        rows += [f"S_rect_{camera}: 64 48", f"P_rect_{camera}: {numbers(*P.ravel())}"]
    written(date / "calib_cam_to_cam.txt", "\n".join(rows))
    for name, T in (("calib_imu_to_velo", T_velo_imu), ("calib_velo_to_cam", T_cam0_velo)):
        text = f"R: {numbers(*T.rotation.ravel())}\nT: {numbers(*T.translation)}\n"
        written(date / f"{name}.txt", text)
    lines = [f"2023-11-14 22:13:{20 + s // 10**9 % 60}.{s % 10**9:09d}" for s in stamps()]
    assert stamps()[0] == 1_700_000_000 * 10**9  # 22:13:20
    (drive / "oxts" / "data").mkdir(parents=True)
    for index, T in enumerate(bodies()):
        latitude, longitude, height = geodetic(T.translation)
        yaw, pitch, roll = Rotation.from_matrix(T.rotation).as_euler("ZYX")
        row = numbers(latitude, longitude, height, roll, pitch, yaw, *[0.0] * 24)
        written(drive / "oxts" / "data" / f"{index:010d}.txt", row)
    for folder in ("image_02", "image_03", "oxts"):
        written(drive / folder / "timestamps.txt", "\n".join(lines))
    return DriveFiles(images=drive)


def kitti_360(root: Path) -> DriveFiles:
    """Frames 250 to 257; poses for all but one, and for others, in KITTI-360's manner."""
    sequence = "2013_05_28_drive_0000_sync"
    numbered = [f"{250 + index:010d}.png" for index in range(len(stamps()))]
    for camera in ("image_00", "image_01"):
        images(root / "data_2d_raw" / sequence / camera / "data_rect", numbered)
    (root / "calibration").mkdir()
    rows = []
    for camera, shift in (("00", 0.0), ("01", -0.5)):
        P = np.column_stack([np.reshape(K, (3, 3)), [50.0 * shift, 0.0, 0.0]])
        rows += [f"S_rect_{camera}: 64 48", f"P_rect_{camera}: {numbers(*P.ravel())}"]
    rows.append("R_rect_00: " + numbers(*np.eye(3).ravel()))
    written(root / "calibration" / "perspective.txt", "\n".join(rows))
    to_pose = "image_00: " + numbers(*T_BODY_CAMERA.as_matrix()[:3].ravel())
    written(root / "calibration" / "calib_cam_to_pose.txt", to_pose + "\nimage_01: 1\n")
    (root / "data_poses" / sequence).mkdir(parents=True)
    poses = [f"{250 + i} {numbers(*T.as_matrix()[:3].ravel())}" for i, T in enumerate(bodies())]
    written(root / "data_poses" / sequence / "poses.txt", "\n".join([*poses[:5], *poses[6:]]))
    return DriveFiles(images=root)


def nuscenes(root: Path) -> DriveFiles:
    """CAM_BACK fires 25 ms after CAM_FRONT_LEFT; sweeps and another scene are there too."""
    tables: dict[str, list[dict[str, object]]] = {
        "scene": [{"token": "s", "name": "scene-1"}, {"token": "o", "name": "scene-2"}],
        "sample": [], "sample_data": [], "ego_pose": [],
        "sensor": [
            {"token": "L", "channel": "CAM_FRONT_LEFT", "modality": "camera"},
            {"token": "R", "channel": "CAM_FRONT", "modality": "camera"},
            {"token": "B", "channel": "CAM_BACK", "modality": "camera"},
        ],
        "calibrated_sensor": [
            {
                "token": f"c{token}", "sensor_token": token, "rotation": wxyz(T),
                "translation": T.translation.tolist(),
                "camera_intrinsic": np.reshape(K, (3, 3)).tolist(),
            }
            for token, T in (("L", T_BODY_CAMERA), ("R", T_BODY_RIGHT), ("B", T_BODY_RIGHT))
        ],
    }  # fmt: skip
    for index, (stamp, T) in enumerate(zip(stamps(), bodies(), strict=True)):
        tables["sample"].append({"token": f"k{index}", "scene_token": "s"})
        for token, channel, late_us in (
            ("L", "CAM_FRONT_LEFT", 0), ("R", "CAM_FRONT", 0), ("B", "CAM_BACK", 25_000)
        ):  # fmt: skip
            name = f"samples/{channel}/n__{channel}__{stamp // 1000 + late_us}.jpg"
            tables["sample_data"].append(
                {
                    "token": f"{token}{index}", "sample_token": f"k{index}", "is_key_frame": True,
                    "ego_pose_token": f"e{token}{index}", "calibrated_sensor_token": f"c{token}",
                    "filename": name, "timestamp": stamp // 1000 + late_us,
                    "width": 64, "height": 48,
                }
            )  # fmt: skip
            tables["ego_pose"].append(
                {
                    "token": f"e{token}{index}", "rotation": wxyz(T),
                    "translation": T.translation.tolist(), "timestamp": stamp // 1000,
                }
            )  # fmt: skip
    sweep = {**tables["sample_data"][0], "is_key_frame": False, "filename": "sweeps/x.jpg"}
    tables["sample_data"].insert(3, sweep)
    (root / "v1.0-mini").mkdir(parents=True)
    for name, rows in tables.items():
        written(root / "v1.0-mini" / f"{name}.json", json.dumps(rows))
    for channel in ("CAM_FRONT_LEFT", "CAM_FRONT", "CAM_BACK"):
        named = [
            Path(str(row["filename"])).name
            for row in tables["sample_data"]
            if str(row["filename"]).startswith(f"samples/{channel}/")
        ]
        images(root / "samples" / channel, named)
    return DriveFiles(images=root, cameras=("CAM_FRONT_LEFT", "CAM_FRONT"), sequence="scene-1")


def euroc_layout(root: Path) -> DriveFiles:
    for camera, T in (("cam0", T_BODY_CAMERA), ("cam1", T_BODY_RIGHT)):
        images(root / "mav0" / camera / "data", [f"{stamp}.png" for stamp in stamps()])
        text = (
            f"%YAML:1.0\nT_BS: {{cols: 4, rows: 4, data: {T.as_matrix().ravel().tolist()}}}\n"
            "resolution: [64, 48]\ncamera_model: pinhole\nintrinsics: [50, 50, 31.5, 23.5]\n"
            "distortion_model: radial-tangential\ndistortion_coefficients: [0, 0, 0, 0]\n"
        )
        written(root / "mav0" / camera / "sensor.yaml", text)
    (root / "mav0" / "state_groundtruth_estimate0").mkdir()
    euroc(root / "mav0" / "state_groundtruth_estimate0")
    return DriveFiles(images=root)


def argoverse2(root: Path) -> DriveFiles:
    sensors = {"ring_front_left": T_BODY_CAMERA, "ring_front_right": T_BODY_RIGHT}
    for name in sensors:
        images(root / "sensors" / "cameras" / name, [f"{stamp}.png" for stamp in stamps()])
    (root / "calibration").mkdir()
    mounted = [[*wxyz(T), *T.translation.tolist()] for T in sensors.values()]
    pose = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    columns = dict(zip(pose, np.transpose(mounted), strict=True))
    table = pa.table({"sensor_name": list(sensors), **columns})
    feather.write_feather(table, root / "calibration" / "egovehicle_SE3_sensor.feather")
    values = {"fx_px": 50.0, "fy_px": 50.0, "cx_px": 31.5, "cy_px": 23.5, "k1": 0.0, "k2": 0.0}
    numbers_ = {name: [value] * 2 for name, value in {**values, "k3": 0.0}.items()}
    size = {
        "width_px": pa.array([64, 64], pa.uint16()),
        "height_px": pa.array([48, 48], pa.uint16()),
    }
    table = pa.table({"sensor_name": list(sensors), **numbers_, **size})
    feather.write_feather(table, root / "calibration" / "intrinsics.feather")
    rows = np.array([[*wxyz(T), *T.translation.tolist()] for T in bodies()])
    table = pa.table({"timestamp_ns": stamps(), **dict(zip(pose, rows.T, strict=True))})
    feather.write_feather(table, root / "city_SE3_egovehicle.feather")
    return DriveFiles(images=root, cameras=("ring_front_left", "ring_front_right"))


def boreas(root: Path) -> DriveFiles:
    """UTM; the rotation is the transposed one of the angles about x, y and z."""
    images(root / "camera", [f"{stamp // 1000}.png" for stamp in stamps()])
    (root / "calib").mkdir()
    written(root / "calib" / "P_camera.txt", "50 0 31.5 0\n0 50 23.5 0\n0 0 1 0\n0 0 0 1\n")
    lines = ["GPSTime,easting,northing,altitude,vel_east,roll,pitch,heading"]
    for index, stamp in enumerate(stamps()):
        t = truth(index).translation + np.array([623423.5, 4848820.25, 153.5])
        heading, pitch, roll = Rotation.from_matrix(truth(index).rotation.T).as_euler("ZYX")
        words = [stamp // 1000, *t.tolist(), 0.0, roll, pitch, heading]
        lines.append(
            ",".join(repr(float(word)) if i else str(word) for i, word in enumerate(words))
        )
    (root / "applanix").mkdir()
    written(root / "applanix" / "camera_poses.csv", "\n".join(lines))
    return DriveFiles(images=root)


CAMERA = (
    '[left]\nsize_px = [64, 48]\nmodel = "pinhole"\nfocal_px = [50, 50]\ncenter_px = [31.5, 23.5]\n'
)


def gnss(root: Path) -> DriveFiles:
    """Semicolons, and columns in another order than people think of."""
    lines = ["image;lat_deg;lon_deg;alt_m;roll_deg;heading_deg;pitch_deg"]
    for stamp, T in zip(stamps(), bodies(), strict=True):
        yaw, pitch, roll = Rotation.from_matrix(T.rotation).as_euler("ZYX", degrees=True)
        words = [*geodetic(T.translation), roll, (90.0 - yaw) % 360.0, -pitch]
        lines.append(";".join([f"{stamp}.png", *(repr(float(word)) for word in words)]))
    folder = images(root / "cam", [f"{stamp}.png" for stamp in stamps()])
    written(root / "cam.toml", f"T_body_left = {T_BODY_CAMERA.as_matrix().tolist()}\n{CAMERA}")
    poses = written(root / "gnss.csv", "\n".join(lines))
    return DriveFiles(images=folder, calibration=root / "cam.toml", poses=poses)


def comma(root: Path) -> DriveFiles:
    """Earth-centred, of a camera with axes ahead, right, down; .npy without its ending."""
    from pyproj import Transformer

    to_ecef = Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lat_0=37.5 +lon_0=-122.3 +h_0=20"
    )
    place = {
        index: np.array(to_ecef.transform(*truth(index).translation.tolist()))
        for index in range(len(stamps()))
    }
    ends = [np.array(to_ecef.transform(*axis)) for axis in np.eye(3).tolist()]
    R_ecef_enu = np.column_stack(ends) - np.array(to_ecef.transform(0.0, 0.0, 0.0))[:, None]
    frd = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # camera from it
    poses = root / "global_pose"
    poses.mkdir(parents=True)
    turns = [R_ecef_enu @ truth(index).rotation @ frd for index in place]
    q = [wxyz(Pose.from_matrix(np.column_stack([turn, np.zeros(3)]))) for turn in turns]
    for name, values in (("positions", np.array(list(place.values()))), ("orientations", q)):
        with (poses / f"frame_{name}").open("wb") as file:
            np.save(file, values)
    folder = images(root / "cam", [f"{stamp}.png" for stamp in stamps()])
    return DriveFiles(images=folder, calibration=written(root / "cam.toml", CAMERA), poses=poses)
