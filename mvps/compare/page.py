"""The comparison as one page that needs nothing else: tables, curves and the picture of normals are inside it."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping
from html import escape

from mvps.report.page import STYLE


def table_html(lines: list[list[str]]) -> str:
    """Title row and rows as a table; figures stand to the right."""
    head, *body = lines

    def row(cells: list[str], tag: str) -> str:
        last = len(cells) - 1
        kinds = ["" if k in (0, last) else ' class="number"' for k in range(len(cells))]
        return "<tr>" + "".join(f"<{tag}{kind}>{escape(cell)}</{tag}>" for kind, cell in zip(kinds, cells, strict=True)) + "</tr>"

    rows = "".join(row(cells, "td") for cells in body)
    return f'<div class="wide"><table><thead>{row(head, "th")}</thead><tbody>{rows}</tbody></table></div>'


def page_html(name: str, tables: Mapping[str, list[list[str]]], curves: Mapping[str, str], normals: bytes | None) -> str:
    """The page. tables: by their headings; curves: SVG by what they show; normals: a PNG of the methods' normals and errors, if any."""
    parts = [f"<section><h2>{escape(head)}</h2>\n{table_html(lines)}</section>" for head, lines in tables.items()]
    parts[1:1] = [f"<section><h2>{escape(title)} against time</h2>\n{text}</section>" for title, text in curves.items()]
    if normals:
        picture = f'<img style="max-width:100%" alt="normals and their errors" src="data:image/png;base64,{b64encode(normals).decode()}">'
        words = "Normals of the first view; below, their errors, black 0 to white 30 degrees."
        parts.append(f"<section><h2>Normals</h2>\n<p>{words}</p>{picture}</section>")
    title = escape(f"Methods on {name}")
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title}</title><style>{STYLE}</style></head>\n<body>\n<h1>{title}</h1>\n" + "\n".join(parts) + "\n</body></html>\n"
    )
