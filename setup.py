"""What pyproject.toml cannot say: the README of an index page, where links into the repository lead
nowhere.
"""

import re
from pathlib import Path

from setuptools import setup


def index_page(readme: str) -> str:
    """The README without pictures of the repository, and with its links into the repository as plain text.

    >>> index_page("![sheet](docs/a.png) [results](docs/results.md), [paper](https://arxiv.org/abs/2303.17147)")
    ' results, [paper](https://arxiv.org/abs/2303.17147)'
    """
    without_pictures = re.sub(r"!\[[^\]]*\]\((?!https?://)[^)]*\)", "", readme)
    return re.sub(r"\[([^\]]*)\]\((?!https?://|#)[^)]*\)", r"\1", without_pictures)


setup(
    long_description=index_page((Path(__file__).parent / "README.md").read_text("utf-8")),
    long_description_content_type="text/markdown",
)
