"""A thread that renders the images of one browser; a new request replaces the current one."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

__all__ = ["Painter"]

Request = TypeVar("Request")
Image = TypeVar("Image")


class Painter(Generic[Request, Image]):
    """Renders the newest request in a thread, as a sequence of successively finer images.

    A new request replaces the current one, but only after the first image of the current one: otherwise no
    image would appear while the camera moves.

    Args:
        frames: yields images of a request, and None between batches of work, when rendering may stop.
        show: receives each image.
        failed: receives an exception raised for a request; the thread continues with the next request.
        lock: held while a batch is computed; shared by all painters that use the same model.
    """

    def __init__(
        self,
        frames: Callable[[Request], Iterator[Image | None]],
        show: Callable[[Image], None],
        failed: Callable[[Exception], None],
        lock: threading.Lock,
    ) -> None:
        self._frames, self._show, self._failed, self._lock = frames, show, failed, lock
        self._changed = threading.Condition()
        self._request: Request | None = None
        self._stopped = False
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def request(self, request: Request) -> None:
        """Request new images. A previous request that has not begun is dropped."""
        with self._changed:
            self._request = request
            self._changed.notify()

    def stop(self) -> None:
        """Stop the thread after the current batch, and wait for its end."""
        with self._changed:
            self._stopped = True
            self._changed.notify()
        self._thread.join()

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._stopped or self._request is not None)
                request, self._request = self._request, None
                if self._stopped:
                    return
            try:
                self._paint(request)
            # Any failure is reported to the user, and the next request may succeed.
            except Exception as error:
                self._failed(error)

    def _paint(self, request: Request) -> None:
        shown, frames = False, self._frames(request)
        while not self._stopped and (self._request is None or not shown):
            with self._lock:
                try:
                    frame = next(frames)
                except StopIteration:
                    return
            if frame is not None:
                self._show(frame)
                shown = True
