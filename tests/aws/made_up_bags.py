"""Bags as deepracer-custom-car writes them, made up: its messages, by the writer of rosbags."""

import io
from pathlib import Path

import numpy as np
from PIL import Image

RESULTS, AUTO_DRIVE = "/inference_pkg/rl_results", "/deepracer_navigation_pkg/auto_drive"
SERVO, STATUS = "/ctrl_pkg/servo_msg", "/device_info_pkg/device_status"
BEGIN_NS = 1_764_150_000_000_000_000
STEERING = (1.0, 0.5, 0.0, -0.5, -1.0)
"""Shares of full lock of the model's actions."""
MESSAGES = {
    "InferResults": "int32 class_label\nfloat32 class_prob\nfloat32 x_min\nfloat32 y_min\nfloat32 x_max\nfloat32 y_max",
    "InferResultsArray": "InferResults[] results\nsensor_msgs/CompressedImage[] images",
    "ServoCtrlMsg": "float32 angle\nfloat32 throttle\nbuiltin_interfaces/Time source_stamp",
    "DeviceStatusMsg": "float32 cpu_percent\nfloat32 cpu_temp\nfloat32 cpu_freq\nfloat32 cpu_freq_max\n"
    "float32 memory_usage\nfloat32 free_disk\nfloat32 latency_mean\nfloat32 latency_p95\nfloat32 fps_mean",
}
PACKAGE = "deepracer_interfaces_pkg/msg/"


def drive_outputs(pictures: int, doubtful: slice = slice(0, 0)) -> np.ndarray:
    """Return probabilities of five actions that lead clearly, but in `doubtful` hardly, (pictures, 5)."""
    outputs = np.full((pictures, 5), 0.025)
    best = np.arange(pictures) // 10 % 5
    outputs[np.arange(pictures), best] = 0.9
    outputs[doubtful] = 0.02
    outputs[doubtful, 0], outputs[doubtful, 4] = 0.49, 0.45
    return outputs


def jpeg(row: int, size: tuple[int, int] = (160, 120)) -> bytes:
    """Return a picture with a bright band whose place depends on the row, in colour as the car stores it."""
    width, height = size
    grey = np.full((height, width), 60, np.uint8)
    left = row * 7 * width // 160 % width
    grey[height // 2 :, left : left + width // 8] = 220
    file = io.BytesIO()
    Image.fromarray(np.repeat(grey[..., None], 3, axis=2)).save(file, "JPEG", quality=95)
    return file.getvalue()


def write_bag(
    folder: Path,
    outputs: np.ndarray,
    storage: str = "sqlite3",
    *,
    pictures: list[bytes] | None = None,
    steering: np.ndarray | None = None,
    taken_ns: np.ndarray | None = None,
    commands: str | None = AUTO_DRIVE,
    stamped: bool = True,
    status: bool = True,
    cameras: int = 1,
    messages: dict[str, str] = MESSAGES,
) -> Path:
    """Write the bag of a drive, 30 pictures a second, each with its command 20 ms later, and return its folder.

    Args:
        folder: to write; its name is the bag's.
        outputs: of the network, (n, k).
        storage: sqlite3 or mcap.
        pictures: JPEG, by default those of `jpeg`.
        steering: share of full lock of each command, by default that of the likeliest of five actions.
        taken_ns: time of each picture.
        commands: topic of the commands; None: they are not logged.
        stamped: whether commands say which picture they are for.
        status: whether the car logs its health.
        cameras: pictures of each decision.
        messages: their definitions.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in messages.items():
        types.register(get_types_from_msg(text, PACKAGE + name))

    def new(name: str, *values: object) -> object:
        known = name if "/" in name else PACKAGE + name
        return types.types[known](*values)

    count = len(outputs)
    if pictures is None:
        pictures = [jpeg(row) for row in range(count)]
    if steering is None:
        steering = np.array(STEERING)[outputs.argmax(axis=1)]
    if taken_ns is None:
        taken_ns = BEGIN_NS + np.arange(count) * 33_333_333
    with Writer(folder, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:

        def add(topic: str, name: str):
            return writer.add_connection(topic, PACKAGE + name, typestore=types)

        results = add(RESULTS, "InferResultsArray")
        driven = None if commands is None else add(commands, "ServoCtrlMsg")
        health = add(STATUS, "DeviceStatusMsg") if status else None
        for row in range(count):
            taken = int(taken_ns[row])
            stamp = new("builtin_interfaces/msg/Time", *divmod(taken, 10**9))
            header = new("std_msgs/msg/Header", stamp, str(row))
            image = new(
                "sensor_msgs/msg/CompressedImage",
                header,
                "bgr8; jpeg compressed bgr8",
                np.frombuffer(pictures[row], np.uint8),
            )
            found = [
                new("InferResults", label, float(value), -1.0, -1.0, -1.0, -1.0)
                for label, value in enumerate(outputs[row])
            ]
            message = new("InferResultsArray", found, [image] * cameras)
            writer.write(
                results, taken + 15_000_000, types.serialize_cdr(message, PACKAGE + "InferResultsArray")
            )
            if driven is not None:
                values = [float(steering[row]), 0.4, stamp] if stamped else [float(steering[row]), 0.4]
                message = new("ServoCtrlMsg", *values)
                writer.write(
                    driven, taken + 20_000_000, types.serialize_cdr(message, PACKAGE + "ServoCtrlMsg")
                )
            if health is not None and row % 30 == 0:
                message = new("DeviceStatusMsg", 71.0, 62.0, 1.0, 1.0, 1.0, 1.0, 20.0, 25.0, 30.0)
                writer.write(
                    health, taken + 25_000_000, types.serialize_cdr(message, PACKAGE + "DeviceStatusMsg")
                )
    return folder
