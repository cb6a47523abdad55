"""Read a sequence in EuRoC's layout: ``mav0`` with cam0, cam1 and state_groundtruth_estimate0."""

from pathlib import Path

from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.calibration_files import read_calibration
from semviz_core.datasets.own_drive.drive_files import DriveFiles
from semviz_core.datasets.own_drive.image_files import list_images
from semviz_core.datasets.own_drive.pose_files import read_poses
from semviz_core.datasets.own_drive.recording import Recording, chosen_cameras

_POSES = ("state_groundtruth_estimate0", "data.csv")


def is_euroc(path: Path) -> bool:
    """Whether a path is ``mav0`` or the folder around it."""
    return (_folder(path) / "cam0" / "sensor.yaml").is_file()


def read_euroc(files: DriveFiles) -> Recording:
    """Return cam0 and cam1, or the chosen cameras; images are named by their time in ns."""
    folder = _folder(files.images)
    known = sorted(path.parent.name for path in folder.glob("cam*/sensor.yaml"))
    cameras = chosen_cameras(files, known, known[:2])
    sides = [folder / camera for camera in cameras]
    calibration = read_calibration(*(side / "sensor.yaml" for side in sides))
    if calibration.T_body_left is None:
        raise SemvizError(f"{sides[0] / 'sensor.yaml'}: no T_BS; complete it")
    images, *right = (side / "data" for side in sides)
    poses = folder.joinpath(*_POSES)
    return Recording(
        images,
        right[0] if right else None,
        list_images(images, right[0] if right else None),
        calibration,
        poses=read_poses(poses, files.quaternion, files.time_unit) if poses.is_file() else None,
    )


def _folder(path: Path) -> Path:
    return path / "mav0" if (path / "mav0").is_dir() else path
