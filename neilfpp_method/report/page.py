"""The complete HTML page: it loads nothing, and its security policy admits only its own two scripts."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from importlib import resources
from typing import NamedTuple

from neilfpp_method.report.markup import Html, element

__all__ = ["PageSection", "page"]


class PageSection(NamedTuple):
    """A section of the page."""

    name: str
    """Identifier, to which links lead."""
    heading: str
    content: Html


def page(title: str, subtitle: str, sections: Sequence[PageSection]) -> str:
    """Build the page.

    Args:
        title: title of the page.
        subtitle: line below the title.
        sections: the sections, in order.
    """
    static = resources.files("neilfpp_method.report") / "static"
    style = (static / "page.css").read_text("utf-8")
    scripts = [(static / name).read_text("utf-8") for name in ("compare.js", "viewer.js")]
    # The policy forbids to load anything and to run any other script, even if escaping failed somewhere.
    hashes = " ".join(f"'sha256-{_sha256(script)}'" for script in scripts)
    policy = f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {hashes}"
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=policy),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("title", title),
        element("style", Html(style)),
    )
    links = (element("a", section.heading, href=f"#{section.name}") for section in sections)
    body = element(
        "body",
        element("header", element("h1", title), element("p", subtitle, class_="pale")),
        element("nav", *links, aria_label="Sections"),
        element("main", *map(_section, sections)),
        *(element("script", Html(script)) for script in scripts),
    )
    return f"<!doctype html>\n{element('html', head, body, lang='en')}\n"


def _section(section: PageSection) -> Html:
    return element("section", element("h2", section.heading), section.content, id=section.name)


def _sha256(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")
