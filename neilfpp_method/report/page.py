"""The complete HTML page: it loads nothing, and its security policy admits only its own two scripts."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from importlib import resources

from neilfpp_method.report.markup import Html, element

__all__ = ["page"]


def page(title: str, subtitle: str, sections: Sequence[tuple[str, str, Html]]) -> str:
    """Build the page.

    Args:
        title: title of the page.
        subtitle: line below the title.
        sections: identifier, heading and content of each section.
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
    links = (element("a", heading, href=f"#{name}") for name, heading, _ in sections)
    body = element(
        "body",
        element("header", element("h1", title), element("p", subtitle, class_="pale")),
        element("nav", *links, aria_label="Sections"),
        element(
            "main", *(element("section", element("h2", h), content, id=name) for name, h, content in sections)
        ),
        *(element("script", Html(script)) for script in scripts),
    )
    return f"<!doctype html>\n{element('html', head, body, lang='en')}\n"


def _sha256(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")
