"""`ns-viewer` shows a picture of the scene to whoever connects."""

from __future__ import annotations

import io
import socket
import threading
import time
from pathlib import Path

import msgspec
import numpy as np
from nerfstudio.scripts.viewer.run_viewer import RunViewer, ViewerConfigWithoutNumRays
from PIL import Image
from viser._messages import ViewerCameraMessage
from websockets.sync.client import connect

from tests.data.make_capture import make_capture
from tests_nerfstudio.runs import ns_train, small_settings, trainer_config


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def test_a_frame_arrives(tmp_path: Path) -> None:
    run = ns_train(trainer_config(make_capture(tmp_path / "capture", background=0.2), tmp_path / "run", small_settings()))
    port = free_port()
    viewer = ViewerConfigWithoutNumRays(websocket_host="127.0.0.1", websocket_port=port)
    threading.Thread(target=RunViewer(run / "config.yml", viewer).main, daemon=True).start()
    camera = ViewerCameraMessage((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -30.0), 0.8, 1.0, (0.0, 0.0, 0.0), (0.0, -1.0, 0.0))
    frame = first_frame(port, msgspec.msgpack.encode(camera.as_serializable_dict()))
    picture = np.asarray(Image.open(io.BytesIO(frame)).convert("RGB"))
    assert min(picture.shape[:2]) > 1
    assert picture.max() > 0, "the background alone is brighter than black"


def first_frame(port: int, camera: bytes, patience: float = 60.0) -> bytes:
    """The first picture that the server sends once it knows the camera."""
    end = time.monotonic() + patience
    while True:
        try:
            server = connect(f"ws://127.0.0.1:{port}", max_size=None)
            break
        except OSError:
            assert time.monotonic() < end, "no server"
            time.sleep(0.2)
    with server:
        server.send(camera)
        while time.monotonic() < end:
            for message in msgspec.msgpack.decode(server.recv(timeout=patience)):
                if message["type"] == "BackgroundImageMessage":
                    return message["rgb_bytes"]
    raise AssertionError("no picture")
