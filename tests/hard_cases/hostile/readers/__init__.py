"""Every reader of untrusted files: valid files to damage, and a function that reads them."""

from __future__ import annotations

from collections.abc import Mapping

from tests.hard_cases.hostile.readers.captures import CAPTURES
from tests.hard_cases.hostile.readers.images import IMAGES
from tests.hard_cases.hostile.readers.reader import Reader
from tests.hard_cases.hostile.readers.runs import RUNS
from tests.hard_cases.hostile.readers.shapes import SHAPES
from tests.hard_cases.hostile.readers.stored import STORED
from tests.hard_cases.hostile.readers.truth import TRUTH

__all__ = ["READERS", "Reader"]

READERS: Mapping[str, Reader] = {**IMAGES, **SHAPES, **CAPTURES, **TRUTH, **RUNS, **STORED}
