"""Images are painted in the background, and the newest request comes first."""

from __future__ import annotations

import threading

import pytest

from neilfpp_method.view.painter import Painter

WAIT = 10.0


class Seen:
    """The images that a painter has shown, and functions that wait for them."""

    def __init__(self):
        self.shown, self.failures, self.news = [], [], threading.Condition()

    def show(self, frame):
        with self.news:
            self.shown.append(frame)
            self.news.notify_all()

    def failed(self, error):
        with self.news:
            self.failures.append(str(error))
            self.news.notify_all()

    def wait(self, condition):
        with self.news:
            assert self.news.wait_for(condition, WAIT), (self.shown, self.failures)


@pytest.fixture
def seen():
    return Seen()


@pytest.fixture
def painting(seen):
    made = []

    def start(frames):
        made.append(Painter(frames, seen.show, seen.failed, threading.Lock()))
        return made[-1]

    yield start
    for painter in made:
        painter.stop()


def test_images_are_shown_in_order(seen, painting):
    painting(lambda wish: iter([None, f"{wish} coarse", None, f"{wish} fine"])).request("a")
    seen.wait(lambda: seen.shown == ["a coarse", "a fine"])


def test_a_new_request_ends_the_refinement_of_the_previous_one(seen, painting):
    reached, newer = threading.Event(), threading.Event()

    def frames(wish):
        yield f"{wish} coarse"
        if wish == "old":
            reached.set()
            assert newer.wait(WAIT)
            yield None
            yield "old fine"

    painter = painting(frames)
    painter.request("old")
    assert reached.wait(WAIT)
    painter.request("new")
    newer.set()
    seen.wait(lambda: seen.shown[-1] == "new coarse")
    assert seen.shown == ["old coarse", "new coarse"]


def test_the_first_image_is_finished_and_intermediate_requests_are_skipped(seen, painting):
    begun, asked = threading.Event(), threading.Event()

    def frames(wish):
        if wish == 0:
            begun.set()
            assert asked.wait(WAIT)
        yield None  # here it could be abandoned
        yield wish

    painter = painting(frames)
    painter.request(0)
    assert begun.wait(WAIT)
    for wish in (1, 2, 3):
        painter.request(wish)
    asked.set()
    seen.wait(lambda: seen.shown[-1:] == [3])
    assert seen.shown == [0, 3]


def test_a_failure_is_reported_and_the_next_request_is_rendered(seen, painting):
    def frames(wish):
        if wish == "bad":
            raise ValueError("no such thing")
        yield wish

    painter = painting(frames)
    painter.request("bad")
    seen.wait(lambda: seen.failures == ["no such thing"])
    painter.request("good")
    seen.wait(lambda: seen.shown == ["good"])
