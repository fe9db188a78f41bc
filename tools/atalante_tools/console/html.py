"""HTML page and tables of a report. The page is a single file and loads nothing from the network."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Final

_STYLE: Final = """
body { font: 14px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 74em; padding: 0 1em; color: #1c1c1c; }
h1 { font-size: 1.4em; } h2 { font-size: 1.1em; margin-top: 2em; } h3 { font-size: 1em; margin-bottom: 0.2em; }
table { border-collapse: collapse; width: 100%; }
th, td { text-align: left; padding: 0.25em 0.7em 0.25em 0; vertical-align: top; }
th { border-bottom: 1px solid #888; } td { border-bottom: 1px solid #e2e2e2; } td.number { text-align: right; }
.bad { color: #a3220f; font-weight: 600; } .good { color: #2d6a1e; font-weight: 600; } .small { color: #555; font-size: 0.9em; }
svg text { font: 11px system-ui, sans-serif; fill: #333; } img { max-width: 100%; }
"""


def page(title: str, heading: str, parts: Sequence[str]) -> str:
    """Return an HTML page.

    Args:
        title: Title of the window.
        heading: First heading of the page.
        parts: HTML elements of the body.
    """
    head = f"<!DOCTYPE html><html lang='en'><head><meta charset='utf-8'><title>{escape(title)}</title>"
    return "\n".join(
        [head, f"<style>{_STYLE}</style></head><body><h1>{escape(heading)}</h1>", *parts, "</body></html>\n"]
    )


def html_table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return an HTML table. Cells with an integer are right-aligned.

    Args:
        head: Headings of the columns.
        rows: Cells of each row.
    """

    def cell(value: object) -> str:
        return f"<td{' class=number' if isinstance(value, int) else ''}>{escape(str(value))}</td>"

    lines = ["<tr>" + "".join(f"<th>{escape(name)}</th>" for name in head) + "</tr>"]
    lines += ["<tr>" + "".join(map(cell, row)) + "</tr>" for row in rows]
    return "\n".join(["<table>", *lines, "</table>"])
