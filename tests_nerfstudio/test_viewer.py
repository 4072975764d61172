"""`ns-viewer` sends images of the scene to its clients."""

from __future__ import annotations

import io
import itertools
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import msgspec
import numpy as np
from PIL import Image
from viser._messages import ViewerCameraMessage
from websockets.sync.client import ClientConnection, connect

from tests.data.make_capture import make_capture
from tests_nerfstudio.runs import ns_train, small_settings, trainer_config


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


@contextmanager
def ns_viewer(config: Path, port: int) -> Iterator[None]:
    """The command in a separate process; it does not end by itself."""
    options = [
        "--load-config",
        str(config),
        "--viewer.websocket-host",
        "127.0.0.1",
        "--viewer.websocket-port",
        str(port),
    ]
    process = subprocess.Popen(
        [Path(sys.executable).parent / "ns-viewer", *options], stdout=subprocess.DEVNULL
    )
    try:
        yield
    finally:
        process.kill()
        process.wait()


def test_a_frame_arrives(tmp_path: Path) -> None:
    run = ns_train(
        trainer_config(make_capture(tmp_path / "capture", background=0.2), tmp_path / "run", small_settings())
    )
    port = free_port()
    with ns_viewer(run / "config.yml", port):
        frame = first_frame(port)
    picture = np.asarray(Image.open(io.BytesIO(frame)).convert("RGB"))
    assert min(picture.shape[:2]) > 1
    assert picture.max() > 0, "the background alone is brighter than black"


def first_frame(port: int, patience: float = 120.0) -> bytes:
    """The first image that the server sends to a client whose camera moves.

    Nerfstudio registers a client by its first camera and only then listens to its cameras, so a camera that
    does not move may be sent too early.
    """
    end = time.monotonic() + patience
    while True:
        try:
            server = connect(f"ws://127.0.0.1:{port}", max_size=None)
            break
        except OSError:
            assert time.monotonic() < end, "no server"
            time.sleep(0.2)
    with server:
        for moved in itertools.count():
            assert time.monotonic() < end, "no picture"
            server.send(camera(-30.0 - 0.01 * moved))
            for message in heard_within(server, 1.0):
                if message["type"] == "BackgroundImageMessage":
                    return message["rgb_bytes"]


def camera(z: float) -> bytes:
    """The camera message of a client."""
    message = ViewerCameraMessage(
        (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, z), 0.8, 1.0, (0.0, 0.0, 0.0), (0.0, -1.0, 0.0)
    )
    return msgspec.msgpack.encode(message.as_serializable_dict())


def heard_within(server: ClientConnection, seconds: float) -> Iterator[dict]:
    """All messages within the next seconds."""
    end = time.monotonic() + seconds
    with suppress(TimeoutError):
        while (left := end - time.monotonic()) > 0:
            yield from msgspec.msgpack.decode(server.recv(timeout=left))
