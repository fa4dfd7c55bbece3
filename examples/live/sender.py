"""Send a recording to `carts live --source socket:PORT`, and print the results.

carts live sequence.toml --source socket:7000 --quiet
python examples/live/sender.py 7000 sequence.toml
"""

import argparse
import socket
import struct
import threading
import time
from pathlib import Path

import cv2
import msgspec

from carts_core.recording import Sequence
from carts_core.resources import sample_sequence


def send(connection: socket.socket, message: dict) -> None:
    """Send a message, preceded by its length."""
    content = msgspec.msgpack.encode(message)
    connection.sendall(struct.pack(">I", len(content)) + content)


def show_results(connection: socket.socket) -> None:
    """Print every result until the connection ends."""
    stream = connection.makefile("rb")
    while len(header := stream.read(4)) == 4:
        result = msgspec.msgpack.decode(stream.read(struct.unpack(">I", header)[0]))
        if result["type"] == "error":
            print(result["message"])
            return
        print(f"{result['id']}: {result['verdict']}, {1000 * result['age']:.0f} ms old, loss {result['loss']:.3f}")


def main() -> None:
    """Send frames at the given rate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("port", type=int)
    parser.add_argument("sequence", type=Path, nargs="?", default=sample_sequence())
    parser.add_argument("--rate", type=float, default=4.0, help="frames per second")
    arguments = parser.parse_args()
    sequence = Sequence.open(arguments.sequence)
    with socket.create_connection(("127.0.0.1", arguments.port)) as connection:
        reader = threading.Thread(target=show_results, args=(connection,), daemon=True)
        reader.start()
        for index in range(len(sequence)):
            frame = sequence.frame(index)
            names = {arm.name: arm.robot.joint_names for arm in sequence.scene.arms}
            joints = {
                arm: dict(zip(names[arm], map(float, values), strict=True)) for arm, values in frame.measured.items()
            }
            images = {
                camera: {"data": cv2.imencode(".jpg", image[..., ::-1])[1].tobytes(), "encoding": "jpeg"}
                for camera, image in frame.images.items()
            }
            message = {"type": "frame", "time": index / arguments.rate, "joints": joints, "images": images}
            send(connection, {**message, "id": frame.frame_id})
            time.sleep(1.0 / arguments.rate)
        time.sleep(1.0)


if __name__ == "__main__":
    main()
