"""Writes the messages of ros2/tests/golden.rs by `rosbags`, an implementation that is not ours.

    python golden.py > ../../ros2/tests/golden.json

What stands there must be what this prints: `./check` compares them where there is Python.
"""

import json
import sys

import numpy as np
import xxhash
import zenoh.ext
from rosbags.typesys import Stores, get_typestore

store = get_typestore(Stores.ROS2_JAZZY)


def make(kind, *fields):
    return store.types[kind](*fields)


def numbers(count, first):
    """The same as `numbers` in golden.rs."""
    return np.array([first + 0.25 * index for index in range(count)])


def time(sec, nanosec):
    return make("builtin_interfaces/msg/Time", sec, nanosec)


def header(frame):
    return make("std_msgs/msg/Header", time(1_700_000_000, 123_456_789), frame)


def vector(x, y, z):
    return make("geometry_msgs/msg/Vector3", x, y, z)


def point(x, y, z):
    return make("geometry_msgs/msg/Point", x, y, z)


def quaternion(x, y, z, w):
    return make("geometry_msgs/msg/Quaternion", x, y, z, w)


def pose():
    return make("geometry_msgs/msg/Pose", point(1.5, -2.25, 0.125), quaternion(0.0, 0.0, 0.6, 0.8))


def covariant_pose():
    return make("geometry_msgs/msg/PoseWithCovariance", pose(), numbers(36, 0.5))


def twist():
    return make("geometry_msgs/msg/Twist", vector(0.5, -0.25, 0.0), vector(0.0, 0.0, -1.75))


def odometry(frame, child):
    covariant = make("geometry_msgs/msg/TwistWithCovariance", twist(), numbers(36, -4.0))
    return make("nav_msgs/msg/Odometry", header(frame), child, covariant_pose(), covariant)


def imu(frame):
    return make(
        "sensor_msgs/msg/Imu", header(frame), quaternion(0.0, 0.0, 0.6, 0.8), numbers(9, 1.0),
        vector(0.01, 0.02, -0.5), numbers(9, 2.0), vector(0.1, -0.2, 9.81), numbers(9, 3.0),
    )


def joints(names, count):
    return make(
        "sensor_msgs/msg/JointState", header("base_link"), names,
        numbers(count, 0.0), numbers(count, 10.0), numbers(count, -1.0),
    )


def stamped_pose():
    return make("geometry_msgs/msg/PoseWithCovarianceStamped", header("map"), covariant_pose())


def battery(cells, place):
    singles = numbers(cells, 3.5).astype(np.float32)
    return make(
        "sensor_msgs/msg/BatteryState", header("battery"), 25.5, 31.25, -4.75, 7.5, 10.0, 10.5, 0.75,
        2, 1, 3, True, singles, singles + np.float32(20), place, "sn-1",
    )


def array(label, count):
    dimensions = [make("std_msgs/msg/MultiArrayDimension", label, 2, 4)] if label else []
    layout = make("std_msgs/msg/MultiArrayLayout", dimensions, 0)
    return make("std_msgs/msg/Float64MultiArray", layout, numbers(count, -1.0))


def path(count):
    poses = [make("geometry_msgs/msg/PoseStamped", header("m" * index), pose()) for index in range(count)]
    return make("nav_msgs/msg/Path", header("map"), poses)


def diagnostics(count):
    def status(index):
        values = [make("diagnostic_msgs/msg/KeyValue", "k" * at, "v" * index) for at in range(index)]
        return make("diagnostic_msgs/msg/DiagnosticStatus", index, "tread: base", "hört", "rover-1", values)

    return make("diagnostic_msgs/msg/DiagnosticArray", header(""), [status(index) for index in range(count)])


messages = {
    "odometry": odometry("odom", "base_link"),
    "odometry_of_a_long_frame": odometry("robot7/odom_frame", ""),
    "imu": imu("imu_link"),
    "imu_without_a_frame": imu(""),
    "joints": joints(["front_left", "front_right", "rear_left", "rear_right"], 4),
    "joints_without_names": joints([], 0),
    "joints_of_odd_names": joints(["a", "bc", "def"], 3),
    "pose": stamped_pose(),
    "battery": battery(6, "slot 1"),
    "battery_without_cells": battery(0, ""),
    "twist": twist(),
    "stamped_twist": make("geometry_msgs/msg/TwistStamped", header("base_link"), twist()),
    "array": array("wheels", 4),
    "plain_array": array("", 2),
    "empty_array": array("", 0),
    "text": make("std_msgs/msg/String", '{"tick": 7, "to": "hört"}'),
    "empty_text": make("std_msgs/msg/String", ""),
    "path": path(3),
    "empty_path": path(0),
    "diagnostics": diagnostics(4),
    "empty_diagnostics": diagnostics(0),
}

# What recordings carry the definition of.
DEFINED = sorted({message.__msgtype__ for message in messages.values()} - {"sensor_msgs/msg/BatteryState"})

TOKEN = "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MS/%/%/listener/%chatter/std_msgs::msg::dds_::String_/::,10:,:,:,,"
gid = xxhash.xxh3_128_intdigest(TOKEN.encode()).to_bytes(16, "little")
attachment = zenoh.ext.z_serialize((zenoh.ext.Int64(41), zenoh.ext.Int64(1_700_000_000_123_456_789), gid))

golden = {
    "messages": {name: bytes(store.serialize_cdr(message, message.__msgtype__)).hex() for name, message in messages.items()},
    "hashes": {kind: store.hash_rihs01(kind) for kind in sorted({message.__msgtype__ for message in messages.values()})},
    "definitions": {kind: store.generate_msgdef(kind, ros_version=2)[0] for kind in DEFINED},
    "token": TOKEN,
    "attachment": bytes(attachment).hex(),
}
json.dump(golden, sys.stdout, indent=1, sort_keys=True, ensure_ascii=False)
sys.stdout.write("\n")
