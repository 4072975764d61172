"""Build HTML from Python values. Text is escaped unless it is an `Html` made by this module."""

from __future__ import annotations

import json
from html import escape
from typing import Any

__all__ = ["Html", "cell", "data_block", "element", "joined", "table", "with_code"]

VOID = frozenset({"br", "hr", "img", "input", "link", "meta"})
"""Elements without content and end tag."""


class Html(str):
    """Text that is HTML. Any other string is escaped when it is put into an element."""


def element(name: str, /, *children: str | None, **attributes: str | int | float | bool | None) -> Html:
    """Build an element.

    Args:
        name: tag name.
        children: content. `Html` is inserted unchanged, other text is escaped, None is skipped.
        attributes: attributes, whose values are escaped. True gives an attribute without value; False and
            None are skipped. A trailing underscore is removed, as in `class_`; other underscores become
            hyphens.

    >>> element("p", "a < b", class_="note", hidden=True)
    '<p class="note" hidden>a &lt; b</p>'
    """
    written = "".join(_attribute(key, value) for key, value in attributes.items())
    if name in VOID:
        return Html(f"<{name}{written}>")
    return Html(f"<{name}{written}>{joined(*children)}</{name}>")


def joined(*parts: str | None) -> Html:
    """Concatenate parts. `Html` is kept unchanged, other text is escaped, None is skipped."""
    return Html(
        "".join(part if isinstance(part, Html) else escape(part) for part in parts if part is not None)
    )


def table(head: tuple[str, ...], *rows: Html, class_: str | None = None) -> Html:
    """Build a table that scrolls horizontally if it is wider than the page.

    Args:
        head: titles of the columns; if empty, the table has no head.
        rows: `tr` elements.
        class_: class of the table.
    """
    titles = element("tr", *(element("th", title, scope="col") for title in head))
    inside = (element("thead", titles) if head else None, element("tbody", *rows))
    return element("div", element("table", *inside, class_=class_), class_="wide")


def with_code(text: str) -> Html:
    """Text in which words between backticks are code.

    >>> with_code("By `neilfpp eval`.")
    'By <code>neilfpp eval</code>.'
    """
    parts = text.split("`")
    return joined(*(element("code", part) if k % 2 else part for k, part in enumerate(parts)))


def cell(text: str) -> Html:
    """Build a table cell for text that may be long."""
    return element("td", text, class_="long")


def data_block(name: str, value: Any) -> Html:
    """Embed a value as JSON, which scripts of the page read by element identifier.

    `<` is escaped, so that no text in the value can end the block.
    """
    text = json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return Html(f'<script type="application/json" id="{escape(name)}">{text}</script>')


def _attribute(key: str, value: str | int | float | bool | None) -> str:
    name = key.removesuffix("_").replace("_", "-")
    if value is None or value is False:
        return ""
    return f" {name}" if value is True else f' {name}="{escape(str(value))}"'
