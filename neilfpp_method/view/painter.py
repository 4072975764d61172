"""A thread that makes one browser's pictures: the newest wish counts, older ones are given up."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

__all__ = ["Painter"]

Asked = TypeVar("Asked")
Made = TypeVar("Made")


class Painter(Generic[Asked, Made]):
    """Shows ever finer pictures of the newest wish.

    A wish's first picture is always finished: nothing would be seen while a camera moves otherwise.

    Args:
        frames: pictures of a wish; None where it can be given up.
        show: takes a picture.
        failed: takes what went wrong with a wish; the thread goes on with the next.
        turn: held while a part of a picture is computed, by all painters that share a model.
    """

    def __init__(
        self,
        frames: Callable[[Asked], Iterator[Made | None]],
        show: Callable[[Made], None],
        failed: Callable[[Exception], None],
        turn: threading.Lock,
    ) -> None:
        self._frames, self._show, self._failed, self._turn = frames, show, failed, turn
        self._news = threading.Condition()
        self._wish: Asked | None = None
        self._ended = False
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def ask(self, wish: Asked) -> None:
        """Wish for something else; what was wished for before and has not begun is forgotten."""
        with self._news:
            self._wish = wish
            self._news.notify()

    def stop(self) -> None:
        """End the thread, at the latest after the part that it computes."""
        with self._news:
            self._ended = True
            self._news.notify()
        self._thread.join()

    def _work(self) -> None:
        while True:
            with self._news:
                self._news.wait_for(lambda: self._ended or self._wish is not None)
                wish, self._wish = self._wish, None
                if self._ended:
                    return
            try:
                self._paint(wish)
            except Exception as error:  # A person must learn of it; the next wish may well go.
                self._failed(error)

    def _paint(self, wish: Asked) -> None:
        shown, frames = False, self._frames(wish)
        while not self._ended and (self._wish is None or not shown):
            with self._turn:
                try:
                    frame = next(frames)
                except StopIteration:
                    return
            if frame is not None:
                self._show(frame)
                shown = True
