"""HTML that is put together from Python values: text is escaped unless it was made here."""

from __future__ import annotations

import json
from html import escape
from typing import Any

__all__ = ["Html", "cell", "data_block", "element", "joined", "table", "with_code"]

VOID = frozenset({"br", "hr", "img", "input", "link", "meta"})
"""Elements that hold nothing and have no end."""


class Html(str):
    """Text that is HTML already; every other string is escaped where it is put into an element."""


def element(name: str, /, *children: str | None, **attributes: str | int | float | bool | None) -> Html:
    """An element.

    Args:
        name: of the element.
        children: `Html` as it is, other text escaped; none is left out.
        attributes: their values are escaped. True stands alone, False and none are left out. An underscore at
            the end goes, as in `class_`; other underscores become dashes.

    >>> element("p", "a < b", class_="note", hidden=True)
    '<p class="note" hidden>a &lt; b</p>'
    """
    written = "".join(_attribute(key, value) for key, value in attributes.items())
    if name in VOID:
        return Html(f"<{name}{written}>")
    return Html(f"<{name}{written}>{joined(*children)}</{name}>")


def joined(*parts: str | None) -> Html:
    """Parts one after the other, escaped where they are no HTML yet."""
    return Html(
        "".join(part if isinstance(part, Html) else escape(part) for part in parts if part is not None)
    )


def table(head: tuple[str, ...], *rows: Html, class_: str | None = None) -> Html:
    """A table that scrolls sideways where it is wider than the page.

    Args:
        head: the columns' titles; without any the table has no head.
        rows: `tr` elements.
        class_: of the table.
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
    """A cell of a table whose text may be long."""
    return element("td", text, class_="long")


def data_block(name: str, value: Any) -> Html:
    """A value that scripts of the page read as JSON, by element identifier; it cannot end the block."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return Html(f'<script type="application/json" id="{escape(name)}">{text}</script>')


def _attribute(key: str, value: str | int | float | bool | None) -> str:
    name = key.removesuffix("_").replace("_", "-")
    if value is None or value is False:
        return ""
    return f" {name}" if value is True else f' {name}="{escape(str(value))}"'
