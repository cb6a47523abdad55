"""Turn a frame of mmdetection3d's pickle into nuScenes' JSON tables, once:

    python tests/nuscenes_tables.py mmdet3d_info.pkl FOLDER

Plain values and arrays are all that it unpickles; any other class is refused.
"""

import json
import pickle
import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

_ALLOWED = ("_codecs", "numpy", "numpy.core.multiarray", "numpy._core.multiarray")


class _PlainUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if module not in _ALLOWED:
            raise pickle.UnpicklingError(f"{module}.{name}")
        return super().find_class(module, name)


def read_frame(source: Path) -> Any:
    """Return the first frame of the pickle."""
    with source.open("rb") as file:
        return _PlainUnpickler(file).load()["data_list"][0]


def write_tables(source: Path, folder: Path, images: Path) -> None:
    """Write the tables of the first frame in ``source``; sizes are those of the images."""
    import cv2

    frame = read_frame(source)
    tables: dict[str, list[dict[str, Any]]] = {
        "scene": [{"token": "scene", "name": "scene"}],
        "sample": [{"token": "sample", "scene_token": "scene"}],
        "sample_data": [], "sensor": [], "calibrated_sensor": [], "ego_pose": [],
    }  # fmt: skip
    for channel, camera in frame["images"].items():
        name = Path(camera["img_path"]).name
        shape = cv2.imread(str(images / "samples" / channel / name)).shape
        T_ego_camera = camera["cam2ego"]
        tables["sensor"].append({"token": channel, "channel": channel, "modality": "camera"})
        tables["calibrated_sensor"].append(
            {
                "token": f"c{channel}", "sensor_token": channel, **_pose(T_ego_camera),
                "camera_intrinsic": np.array(camera["cam2img"])[:3, :3].tolist(),
            }
        )  # fmt: skip
        tables["ego_pose"].append({"token": f"e{channel}", **_pose(frame["ego2global"])})
        tables["sample_data"].append(
            {
                "token": channel, "sample_token": "sample", "ego_pose_token": f"e{channel}",
                "calibrated_sensor_token": f"c{channel}", "is_key_frame": True,
                "filename": f"samples/{channel}/{name}", "width": shape[1], "height": shape[0],
                "timestamp": round(float(camera["timestamp"]) * 1e6),
            }
        )  # fmt: skip
    folder.mkdir(parents=True)
    for table, rows in tables.items():
        (folder / f"{table}.json").write_text(json.dumps(rows))


def _pose(matrix: Any) -> dict[str, list[float]]:
    T = np.array(matrix, dtype=np.float64)
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    return {"rotation": [w, x, y, z], "translation": T[:3, 3].tolist()}


if __name__ == "__main__":
    write_tables(Path(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[1]).parent)
