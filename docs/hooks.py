"""Hooks of mkdocs, which make the built pages complete in themselves: no script and no internet is needed.

Formulas become MathML, which browsers draw by themselves: pymdownx.arithmatex marks them in the Markdown, and
`convert` is asked for what it marked. Figures of experiments, which pages show from where they are committed
(`../experiments/NAME/figure.png`, as it works in the repository too), are copied into the site. Notebooks
become pages of what they say and show.
"""

import html
import json
import logging
import re
import shutil
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.structure.files import File
from mkdocs.utils import get_relative_url

_ROOT = Path(__file__).resolve().parents[1]
# `\(...\)` within a line in a span, `\[...\]` on lines of its own in a div.
_MARKED = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\s*\\[(\[](?P<latex>.*?)\\[)\]]\s*</(?P=tag)>', re.DOTALL
)
_FIGURE = re.compile(r'(?<=src=")(?:\.\./)+(experiments/[^"]+)(?=")')
_NOTEBOOK = re.compile(r"(?<=notebooks/)(\w+)\.ipynb(?=\))")
_log = logging.getLogger("mkdocs.hooks")  # whose warnings end a strict build
_shown: set[str] = set()


def on_files(files, config, **_):
    """A page for each notebook."""
    for file in list(files):
        if file.src_uri.endswith(".ipynb"):
            text = _page_of(json.loads(Path(file.abs_src_path).read_text(encoding="utf-8")))
            files.append(File.generated(config, file.src_uri.replace(".ipynb", ".md"), content=text))
    return files


def on_page_markdown(markdown, **_):
    """The page's Markdown with links to the pages of notebooks."""
    return _NOTEBOOK.sub(r"\1.md", markdown)


def on_page_content(content, page, **_):
    """The page's HTML with MathML in place of LaTeX, and figures where the site will have them."""

    def figure(found: re.Match) -> str:
        if (_ROOT / found[1]).is_file():
            _shown.add(found[1])
        else:
            _log.warning(f"{page.file.src_uri}: there is no {found[1]}")
        return get_relative_url(found[1], page.url)

    return _FIGURE.sub(figure, _MARKED.sub(_mathml, content))


def on_post_build(config, **_):
    """Copy the figures that pages show."""
    for path in sorted(_shown):
        target = Path(config.site_dir, path)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(_ROOT / path, target)


def _page_of(notebook: dict) -> str:
    """What a notebook says and shows, as Markdown."""
    blocks = []
    for cell in notebook["cells"]:
        text = "".join(cell["source"])
        blocks.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
        for output in cell.get("outputs", ()):
            if "text" in output:
                blocks.append(f"```\n{''.join(output['text']).rstrip()}\n```")
            elif "image/jpeg" in output.get("data", {}):
                blocks.append(f"![](data:image/jpeg;base64,{''.join(output['data']['image/jpeg']).strip()})")
    return "\n\n".join(blocks)


def _mathml(found: re.Match) -> str:
    display = "block" if found["tag"] == "div" else "inline"
    formula = convert(html.unescape(found["latex"]), display=display)
    return f'<div class="formula">{formula}</div>' if display == "block" else formula
