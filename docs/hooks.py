"""Hooks of mkdocs, which make the built pages complete in themselves: no script and no internet is needed.

Formulas become MathML, which browsers draw by themselves: pymdownx.arithmatex marks them in the Markdown, and
`convert` is asked for what it marked. Figures of experiments, which pages show from where they are committed
(`../experiments/NAME/figure.png`, as it works in the repository too), are copied into the site.
"""

import html
import logging
import re
import shutil
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.utils import get_relative_url

_ROOT = Path(__file__).resolve().parents[1]
# `\(...\)` within a line in a span, `\[...\]` on lines of its own in a div.
_MARKED = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\s*\\[(\[](?P<latex>.*?)\\[)\]]\s*</(?P=tag)>', re.DOTALL
)
_FIGURE = re.compile(r'(?<=src=")(?:\.\./)+(experiments/[^"]+)(?=")')
_log = logging.getLogger("mkdocs.hooks")  # whose warnings end a strict build
_shown: set[str] = set()


def on_page_content(content, page, **_):
    """The page's HTML with MathML in place of LaTeX, and figures where the site will have them."""

    def figure(found: re.Match) -> str:
        if not (_ROOT / found[1]).is_file():
            _log.warning(f"{page.file.src_uri}: there is no {found[1]}")
        _shown.add(found[1])
        return get_relative_url(found[1], page.url)

    return _FIGURE.sub(figure, _MARKED.sub(_mathml, content))


def on_post_build(config, **_):
    """Copy the figures that pages show."""
    for path in sorted(_shown):
        target = Path(config.site_dir, path)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(_ROOT / path, target)


def _mathml(found: re.Match) -> str:
    display = "block" if found["tag"] == "div" else "inline"
    formula = convert(html.unescape(found["latex"]), display=display)
    return f'<div class="formula">{formula}</div>' if display == "block" else formula
