"""A hook of mkdocs: formulas become MathML, which browsers draw by themselves, so pages need no script and no
internet. pymdownx.arithmatex finds them in the Markdown and marks them; this converts what it marked."""

import html
import re

from latex2mathml.converter import convert

# `\(...\)` within a line in a span, `\[...\]` on lines of its own in a div.
_MARKED = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\s*\\[(\[](?P<latex>.*?)\\[)\]]\s*</(?P=tag)>', re.DOTALL
)


def on_page_content(content, **_):
    """The page's HTML with MathML in place of LaTeX."""
    return _MARKED.sub(_mathml, content)


def _mathml(found: re.Match) -> str:
    display = "block" if found["tag"] == "div" else "inline"
    formula = convert(html.unescape(found["latex"]), display=display)
    return f'<div class="formula">{formula}</div>' if display == "block" else formula
