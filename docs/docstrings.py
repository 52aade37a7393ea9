"""The docstrings of this project as HTML, for the API pages (an extension of Griffe, named in mkdocs.yml).

Docstrings here are plain text, not Markdown: `*` and `_` are themselves, formulas stand indented, and names stand in columns,

    name    what it is; what goes on
            stands below

which becomes a table if there are two and more; its cells may hold formulas again. What is indented otherwise stays as it is typed.
"""

from __future__ import annotations

import re
from html import escape
from textwrap import dedent
from typing import Any

import griffe

NAMED = re.compile(r"( *)(\S(?:(?!  ).){0,47}?)  +(?=\S)")
"""Indent and name of a line in columns: two spaces end the name."""


def as_html(text: str) -> str:
    """Paragraphs, formulas and tables of a docstring."""
    return "\n".join(_blocks(text.split("\n")))


def _blocks(lines: list[str], tables: bool = True) -> list[str]:
    """tables: whether there may be some; not in the cells of one."""
    made = []
    while lines:
        if not lines[0].strip():
            lines = lines[1:]
            continue
        count, html = (tables and _table(lines)) or _formula(lines) or _paragraph(lines, tables)
        made.append(html)
        lines = lines[count:]
    return made


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip())


def _named(line: str) -> tuple[int, str, int] | None:
    """Indent, name and column of the text; None where a line is no name with a text. Formulas have such gaps too."""
    match = NAMED.match(line)
    if not match or re.search(r"[=<]|,$|:$", match[2]):
        return None
    return len(match[1]), match[2], match.end()


def _table(lines: list[str]) -> tuple[int, str] | None:
    """Rows that begin like the first line, with all that stands below their texts; how many lines that is."""
    first = _named(lines[0])
    if first is None:
        return None
    indent, _, column = first
    rows: list[tuple[str, list[str]]] = []
    at = 0
    while at < len(lines):
        found = _named(lines[at])
        if found and (found[0], found[2]) == (indent, column):
            rows.append((found[1], [lines[at][column:]]))
        elif not lines[at].strip() or _indent(lines[at]) >= column:
            rows[-1][1].append(lines[at][column:])
        else:
            break
        at += 1
    if len(rows) < 2:
        return None
    cells = (f"<tr><td><code>{escape(name)}</code></td><td>{''.join(_blocks(text, tables=False))}</td></tr>" for name, text in rows)
    return at, f'<table class="columns"><tbody>{"".join(cells)}</tbody></table>'


def _formula(lines: list[str]) -> tuple[int, str] | None:
    count = next((k for k, line in enumerate(lines) if not _indent(line)), len(lines))
    if not count:
        return None
    return count, f"<pre><code>{escape(dedent(chr(10).join(lines[:count])))}</code></pre>"


def _paragraph(lines: list[str], tables: bool) -> tuple[int, str]:
    others = (k for k, line in enumerate(lines) if k and (not line.strip() or _indent(line) or (tables and _table(lines[k:]))))
    count = next(others, len(lines))
    words = escape(" ".join(line.strip() for line in lines[:count]), quote=False)
    words = re.sub("`([^`]+)`", r"<code>\1</code>", words)
    return count, f"<p>{words}</p>"


class Plain(griffe.Extension):
    """Puts HTML in place of every docstring that is loaded."""

    def on_object(self, *, obj: Any, **_: Any) -> None:
        """Of modules, classes, functions and constants alike."""
        if obj.docstring is not None:
            obj.docstring.value = as_html(obj.docstring.value)
