"""Bridge between ROS 2 and `carts live --source socket:PORT`, not run by the tests, since it requires ROS 2.

    carts live sequence.toml --source socket:7000 --quiet
    python examples/live/ros2_bridge.py --port 7000 --image /stereo/left/image_raw/compressed --camera left --arm PSM1

It subscribes to compressed images and to ARM/measured_js and ARM/jaw/measured_js, and publishes corrected joints as
carts/ARM/corrected_js (sensor_msgs/JointState) and the verdict as carts/verdict (std_msgs/String).
"""

import argparse
import socket
import struct
import threading

import msgspec
import rclpy  # pyright: ignore[reportMissingImports]
from rclpy.node import Node  # pyright: ignore[reportMissingImports]
from rclpy.qos import qos_profile_sensor_data  # pyright: ignore[reportMissingImports]
from sensor_msgs.msg import CompressedImage, JointState  # pyright: ignore[reportMissingImports]
from std_msgs.msg import String  # pyright: ignore[reportMissingImports]


class Bridge(Node):
    """ROS 2 node that sends published images and joints to `carts live`, and publishes its results."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        super().__init__("carts_live")
        self._camera, self._sending = arguments.camera, threading.Lock()
        self._connection = socket.create_connection(("127.0.0.1", arguments.port))
        self._corrected = {
            arm: self.create_publisher(JointState, f"carts/{arm}/corrected_js", 5) for arm in arguments.arm
        }
        self._verdict = self.create_publisher(String, "carts/verdict", 5)
        self.create_subscription(CompressedImage, arguments.image, self._image, qos_profile_sensor_data)
        for arm in arguments.arm:
            for topic in (f"/{arm}/measured_js", f"/{arm}/jaw/measured_js"):
                self.create_subscription(JointState, topic, lambda message, arm=arm: self._joints(arm, message), 5)
        threading.Thread(target=self._results, daemon=True).start()

    def _send(self, stamp, **content) -> None:
        time = stamp.sec + 1e-9 * stamp.nanosec
        packed = msgspec.msgpack.encode({"type": "frame", "time": time, **content})
        with self._sending:
            self._connection.sendall(struct.pack(">I", len(packed)) + packed)

    def _image(self, message) -> None:
        encoding = "png" if "png" in message.format else "jpeg"
        images = {self._camera: {"data": bytes(message.data), "encoding": encoding}}
        self._send(message.header.stamp, images=images)

    def _joints(self, arm: str, message) -> None:
        self._send(
            message.header.stamp, joints={arm: dict(zip(message.name, map(float, message.position), strict=True))}
        )

    def _results(self) -> None:
        stream = self._connection.makefile("rb")
        while len(header := stream.read(4)) == 4:
            result = msgspec.msgpack.decode(stream.read(struct.unpack(">I", header)[0]))
            if result["type"] == "error":
                self.get_logger().error(result["message"])
                return
            self._verdict.publish(String(data=result["verdict"]))
            for arm, publisher in self._corrected.items():
                joints = JointState(name=list(result["joints"][arm]))
                joints.header.stamp = self.get_clock().now().to_msg()
                joints.position = [position for position, _ in result["joints"][arm].values()]
                publisher.publish(joints)


def main() -> None:
    """Run until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--image", required=True, help="topic of compressed images")
    parser.add_argument("--camera", required=True, help="name of the camera in the sequence file")
    parser.add_argument("--arm", action="append", required=True, help="name of an arm; may be given several times")
    arguments, others = parser.parse_known_args()
    rclpy.init(args=others)
    node = Bridge(arguments)
    try:
        rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
