"""A ROS 2 node that tracks a camera in a map: detections and odometry in, poses out.

Start it with the map: python ros2_node.py town.parquet. Messages: vision_msgs/Detection2DArray with
the two ends of a pole as the corners of a box; nav_msgs/Odometry of the camera; a first
PoseWithCovarianceStamped of GNSS. Adapt ``elements_of`` to what your detector publishes.
"""

import sys

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry as OdometryMessage
from rclpy.node import Node
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo
from vision_msgs.msg import Detection2DArray

from semviz import Camera, Elements2D, Localizer, Odometry, Pose, Prior, Tracker, load_map


def pose_of(message) -> Pose:
    p, q = message.position, message.orientation
    return Pose(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), np.array([p.x, p.y, p.z]))


def elements_of(message: Detection2DArray) -> Elements2D:
    boxes = [(each.bbox, int(each.results[0].hypothesis.class_id)) for each in message.detections]
    top = [[box.center.position.x, box.center.position.y - box.size_y / 2] for box, _ in boxes]
    bottom = [[box.center.position.x, box.center.position.y + box.size_y / 2] for box, _ in boxes]
    return Elements2D.from_ends(top, bottom, [class_id for _, class_id in boxes])


class SemvizNode(Node):
    def __init__(self, map_path: str) -> None:
        super().__init__("semviz")
        self.map = load_map(map_path)
        Localizer(classes=self.map.classes).warmup()  # compiles, before a message waits for it
        self.tracker = self.prior = self.now = self.before = None
        self.create_subscription(CameraInfo, "camera_info", self.on_camera, 1)
        self.create_subscription(OdometryMessage, "odometry", self.on_odometry, 10)
        self.create_subscription(PoseWithCovarianceStamped, "fix", self.on_fix, 1)
        self.create_subscription(Detection2DArray, "detections", self.on_detections, 1)
        self.publisher = self.create_publisher(PoseWithCovarianceStamped, "pose", 1)

    def on_camera(self, message: CameraInfo) -> None:
        if self.tracker is None:
            K = np.reshape(message.p, (3, 4))[:, :3]  # of rectified images
            self.tracker = Tracker(Camera(message.width, message.height, K), self.map)

    def on_odometry(self, message: OdometryMessage) -> None:
        self.now = pose_of(message.pose.pose)

    def on_fix(self, message: PoseWithCovarianceStamped) -> None:
        sigma_m = float(np.sqrt(message.pose.covariance[0]))
        self.prior = Prior(pose_of(message.pose.pose).translation, horizontal_sigma_m=sigma_m)

    def on_detections(self, message: Detection2DArray) -> None:
        if self.tracker is None:
            return
        odometry = None
        if self.now is not None and self.before is not None:
            step = self.now.inverse() @ self.before
            odometry = Odometry(step, np.diag([0.02**2] * 3 + [0.002**2] * 3))
        self.before = self.now
        track = self.tracker.step(elements_of(message), odometry, self.prior)
        self.prior = None  # a fix counts once
        if track.T_camera_map is None:
            return self.get_logger().info(track.reason)
        self.publish(track, message.header.stamp)

    def publish(self, track, stamp) -> None:
        T_map_camera = track.T_camera_map.inverse()
        message = PoseWithCovarianceStamped()
        message.header.stamp, message.header.frame_id = stamp, "map"
        p, q = message.pose.pose.position, message.pose.pose.orientation
        p.x, p.y, p.z = T_map_camera.translation.tolist()
        q.x, q.y, q.z, q.w = T_map_camera.as_quaternion().tolist()
        R = np.kron(np.eye(2), T_map_camera.rotation)  # to the map's axes, as ROS has it
        message.pose.covariance = (R @ track.covariance @ R.T).ravel().tolist()
        self.publisher.publish(message)


rclpy.init()
rclpy.spin(SemvizNode(sys.argv[1]))
