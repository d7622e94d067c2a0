"""A page's content as HTML: six shapes of plain text, and figures with their numbers folded away.

By hand, not by templates: each text is escaped in the one function that makes it.
"""

from collections.abc import Sequence

from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.lines import figure_lines
from ccd_casadi.drawing.maps import figure_landscape
from ccd_casadi.drawing.numbers import tables_of
from ccd_casadi.drawing.page import document, escape, table_html, typeset
from ccd_casadi.drawing.turntable import modes_html

SIGNS = {"passed": "✓", "warned": "!", "failed": "✕", "unknown": "?"}
BADGES = {"passed": "good", "warned": "warn", "failed": "bad", "unknown": "open"}
STANDINGS = {"good": "✓", "warn": "!", "bad": "✕"}


def page_html(page: c.Page) -> str:
    """The whole document."""
    body, contents = [], []
    for i, chapter in enumerate(page.chapters, 1):
        heading = escape(chapter.heading)
        contents.append(f'<a href="#section-{i}">{heading}</a>')
        kind = " class=own-page" if chapter.own_page else ""
        blocks = blocks_html(chapter.body, f"s{i}")
        body.append(f'<section id="section-{i}"{kind}>\n<h2>{heading}</h2>\n{blocks}\n</section>')
    up = f'<nav><a href="{escape(page.index)}">All pages of this run</a></nav>\n'
    head = (
        f"{up if page.index else ''}<header>{head_html(page.head)}\n"
        f'<nav class="contents">{" · ".join(contents)}</nav></header>'
    )
    return document(page.head.title, head, "\n".join(body))


def blocks_html(blocks: Sequence[c.Block], key: str) -> str:
    """What stands under a heading; `key` is unique in the page."""
    return "\n".join(block_html(block, f"{key}{i}") for i, block in enumerate(blocks))


def block_html(block: c.Block, key: str) -> str:
    """One of it."""
    match block:
        case c.Words(text):
            return f"<p>{escape(typeset(text))}</p>"
        case c.Heading(text):
            return f"<h3>{escape(text)}</h3>"
        case c.Source(text):
            return f"<pre>{escape(text)}</pre>"
        case c.Bullets(items):
            return f"<ul>{''.join(f'<li>{escape(typeset(words))}</li>' for words in items)}</ul>"
        case c.Links(pages):
            linked = (f'<li><a href="{escape(to)}">{escape(title)}</a>: {escape(words)}</li>'
                      for to, title, words in pages)  # fmt: skip
            return f"<ul>{''.join(linked)}</ul>"
        case c.Facts(rows):
            body = "\n".join(
                f'<tr><th scope="row">{escape(what)}</th><td>{escape(typeset(value))}</td>'
                f"<td>{escape(typeset(remark))}</td></tr>"
                for what, value, remark in rows
            )
            return f'<table class="wide"><tbody>{body}</tbody></table>'
        case c.Table():
            return table_html(block)
        case c.Picture(svg):
            return svg
        case c.Figure():
            return _figure(block, key)
        case c.Steps():
            return _steps(block, key)
        case c.Verdict(lines):
            return verdict_html(lines)


def drawing_html(drawing: c.Drawing, key: str) -> str:
    """A figure by itself."""
    match drawing:
        case c.Lines():
            return figure_lines(drawing, key)
        case c.Landscape():
            return figure_landscape(drawing, key)
        case c.Modes():
            return modes_html(drawing)
        case c.Picture(svg):
            return svg


def _figure(figure: c.Figure, key: str) -> str:
    tables = "\n".join(map(table_html, figure.tables or tables_of(figure.drawing)))
    return (
        f'<figure>\n<div class="drawing">{drawing_html(figure.drawing, key)}</div>\n'
        f"<figcaption>{escape(typeset(figure.caption))}</figcaption>\n"
        f'<details><summary>Data of this figure</summary><div class="scroll">\n{tables}\n'
        "</div></details>\n</figure>"
    )


def _steps(found: c.Steps, key: str) -> str:
    """Without the script, and on paper, the picture that is shown stands alone."""
    shown = "".join(
        f'\n<div class="step"{"" if i == found.first else " hidden"}><p>{escape(words)}</p>'
        f"{figure_lines(lines, f'{key}-{i}')}</div>"
        for i, (words, lines) in enumerate(found.steps)
    )
    slider = f'<input type="range" min="0" max="{len(found.steps) - 1}" value="{found.first}">'
    return f'<div class="steps"><label hidden>{escape(found.label)} {slider}</label>{shown}\n</div>'


def head_html(head: c.Head) -> str:
    """Of a page, or of a cell of a notebook."""
    badge = f'<span class="badge {head.badge}">{STANDINGS[head.badge]} {escape(head.status)}</span>'
    decision = f'<p class="decision">{escape(typeset(head.decision))}</p>\n'
    return (
        f"<h1>{escape(head.title)}</h1>\n{decision if head.decision else ''}"
        f"<p class='standing'>{badge} {escape(typeset(head.reason))}</p>\n"
        f'<p class="meta">{escape(head.meta)}</p>\n'
        f'<p class="lead">{escape(typeset(head.lead))}</p>\n{verdict_html(head.verdict)}'
    )


def verdict_html(lines: Sequence[c.VerdictLine]) -> str:
    """The lines as a table; nothing where there are none."""
    rows = "\n".join(
        f'<tr><th scope="row">{escape(line.name)}</th><td><span class="badge {BADGES[line.state]}">'
        f"{SIGNS[line.state]} {escape(line.state)}</span></td>"
        f"<td>{escape(typeset(line.words))}</td></tr>"
        for line in lines
    )
    return f'<table class="wide verdict"><tbody>{rows}</tbody></table>' if rows else ""
